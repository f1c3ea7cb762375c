"""Essential matrices and homographies: from minimal samples, into motions, and their errors.

For matches x_1, x_2 in undistorted image coordinates and points_2 = R points_1 + t: x_2^T E x_1 = 0 with E = [t]x R,
and x_2 ~ H x_1 with H = R + t n^T for points on the plane n^T points_1 = 1.
"""

from __future__ import annotations

import itertools
import math
from functools import lru_cache

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchslam.geometry.camera import Camera
from torchslam.geometry.lie import homogeneous, matrix_from_quaternion, quaternion_from_matrix, skew
from torchslam.geometry.precision import full_precision

# The unknowns are x, y, z in E = x E_0 + y E_1 + z E_2 + E_3. The monomials by their powers of x, y, z: first those
# that are eliminated, then x, y and 1 times powers of z (Nister, 2004, table 1).
_ELIMINATED = ("xxx", "yyy", "xxy", "xyy", "xxz", "xx", "yyz", "yy", "xyz", "xy")
_KEPT = ("x", "xz", "xzz", "y", "yz", "yzz", "", "z", "zz", "zzz")
# Columns of x_2 x_1^T to solve for; the other four span the null space. Independent also for small motions.
_SOLVED, _FREE = (0, 1, 2, 4, 5), (3, 6, 7, 8)
_GRID = 256  # intervals in which to look for sign changes


@full_precision
def five_point(
    x_1: Float[Tensor, "B 5 2"], x_2: Float[Tensor, "B 5 2"]
) -> tuple[Float[Tensor, "R 3 3"], Int[Tensor, " R"]]:
    """Compute the essential matrices of samples of five matches.

    Solutions closer together than 1.4 degrees of the last unknown's angle can be missed; degenerate samples may
    give none or wrong ones. Not differentiable by design: it generates hypotheses. Source: Nister, "An efficient
    solution to the five-point relative pose problem", 2004.

    Returns:
        E of norm sqrt(2), the R real solutions of all samples together, up to ten each, and the sample of each,
        ascending.
    """
    with torch.no_grad():
        basis = _null_space(x_1, x_2)
        B = _elimination(_constraints(basis))
        z, sample = _real_roots(_determinant(B))
        # B(z) [x, y, 1]^T = 0: the null vector is the largest cross product of two rows.
        b_0, b_1, b_2, b_3, b_4 = B[sample].unbind(-1)
        at = z[:, None, None]
        rows = b_0 + at * (b_1 + at * (b_2 + at * (b_3 + at * b_4)))
        rows = rows / rows.norm(dim=-1, keepdim=True)
        normals = torch.linalg.cross(rows, rows.roll(1, dims=-2), dim=-1)
        largest = (normals * normals).sum(-1).argmax(-1)
        x, y, w = normals.gather(1, largest[:, None, None].expand(-1, 1, 3)).squeeze(1).unbind(-1)
        E = (torch.stack((x, y, z * w, w), dim=-1)[:, None] @ basis[sample]).squeeze(1)
        E = E * (math.sqrt(2) / E.norm(dim=-1, keepdim=True))
        good = torch.isfinite(E).all(-1)
    return E[good].unflatten(-1, (3, 3)), sample[good]


def _null_space(x_1: Float[Tensor, "B 5 2"], x_2: Float[Tensor, "B 5 2"]) -> Float[Tensor, "B 4 9"]:
    """Four orthonormal solutions of the five epipolar equations."""
    equations = (homogeneous(x_2)[..., :, None] * homogeneous(x_1)[..., None, :]).flatten(-2)
    solved = torch.linalg.solve_ex(equations[..., _SOLVED], -equations[..., _FREE])[0].nan_to_num()
    basis = solved.new_zeros(len(solved), 4, 9)
    basis[..., _SOLVED] = solved.mT
    basis[..., range(4), _FREE] = 1.0
    rows: list[Tensor] = []
    for i in range(4):  # Gram-Schmidt
        row = basis[:, i : i + 1]
        for other in rows:
            row = row - (row @ other.mT) * other
        rows.append(row / row.norm(dim=-1, keepdim=True))
    return torch.cat(rows, dim=1)


@lru_cache(maxsize=16)
def _monomials(dtype: torch.dtype, device: torch.device) -> tuple[Tensor, Tensor]:
    """The pairs of unknowns (x, y, z or 1), (2, 10), and the monomial of each product of a pair and a third.

    (20, 40), with one half for pairs of equals: the coefficients of the pairs are summed over both orders.
    """
    pairs = list(itertools.combinations_with_replacement(range(4), 2))
    columns = _ELIMINATED + _KEPT
    table = torch.zeros(len(columns), len(pairs), 4, dtype=dtype, device=device)
    for p, (i, j) in enumerate(pairs):
        for k in range(4):
            monomial = "".join(sorted("xyz "[index] for index in (i, j, k))).strip()
            table[columns.index(monomial), p, k] = 0.5 if i == j else 1.0
    return torch.tensor(pairs, device=device).T, table.flatten(1)


def _constraints(basis: Float[Tensor, "B 4 9"]) -> Float[Tensor, "B 10 20"]:
    """Ten cubic equations: 2 E E^T E = tr(E E^T) E and det E = 0."""
    (first, second), table = _monomials(basis.dtype, basis.device)
    E = basis.permute(1, 2, 0).contiguous().view(4, 3, 3, -1)  # the samples last
    E_1, E_2 = E[first], E[second]
    gram = _matrix_product(E_1, E_2.transpose(1, 2))
    traceless = gram + gram.transpose(1, 2)
    traceless.diagonal(dim1=1, dim2=2).sub_(gram.diagonal(dim1=1, dim2=2).sum(-1, keepdim=True))
    cubic = _matrix_product(traceless[:, None], E)
    normals = torch.linalg.cross(E_1[:, 1], E_2[:, 2], dim=1) + torch.linalg.cross(
        E_2[:, 1], E_1[:, 2], dim=1
    )
    determinant = (normals[:, None] * E[:, 0]).sum(2)
    rows = (
        (table @ part.reshape(table.shape[1], -1)).view(len(table), math.prod(part.shape[2:-1]), len(basis))
        for part in (cubic, determinant)
    )
    return torch.cat(tuple(rows), dim=1).permute(2, 1, 0)


def _matrix_product(A: Tensor, B: Tensor) -> Tensor:
    """Products of 3 x 3 matrices that lie in the dimensions before the last. (..., 3, 3, S) twice."""
    product = A[..., :, :1, :] * B[..., :1, :, :]
    for k in (1, 2):
        product.addcmul_(A[..., :, k : k + 1, :], B[..., k : k + 1, :, :])
    return product


def _elimination(constraints: Float[Tensor, "B 10 20"]) -> Float[Tensor, "B 3 3 5"]:
    """Three equations in x, y, 1 with polynomials in z, lowest power first."""
    reduced = torch.linalg.solve_ex(constraints[..., :10], constraints[..., 10:])[0]
    # rows 4 to 9 are x^2 z, x^2, y^2 z, y^2, xyz, xy; each first minus z times the second cancels
    x, y, one = reduced[:, 4:, :3], reduced[:, 4:, 3:6], reduced[:, 4:, 6:]
    pad = torch.nn.functional.pad
    padded = torch.stack((pad(x, (1, 2)), pad(y, (1, 2)), pad(one, (1, 1))), dim=2)
    return padded[:, 0::2, :, 1:] - padded[:, 1::2, :, :-1]


@lru_cache(maxsize=16)
def _product_table(count_a: int, count_b: int, dtype: torch.dtype, device: torch.device) -> Tensor:
    """(A B, A + B - 1) which power each product of two coefficients belongs to."""
    power = torch.arange(count_a, device="cpu")[:, None] + torch.arange(count_b, device="cpu")
    return torch.nn.functional.one_hot(power.flatten()).to(dtype=dtype, device=device)


def _product(a: Tensor, b: Tensor) -> Tensor:
    """Products of polynomials. (..., A), (..., B) -> (..., A + B - 1)."""
    table = _product_table(a.shape[-1], b.shape[-1], a.dtype, a.device)
    return (a[..., :, None] * b[..., None, :]).flatten(-2) @ table


def _determinant(B: Float[Tensor, "B 3 3 5"]) -> Float[Tensor, "B 11"]:
    """The determinant, a polynomial of degree ten, lowest power first."""
    x, y, one = B[:, :, 0, :4], B[:, :, 1, :4], B[:, :, 2]
    minors = _product(y.roll(-1, 1), one.roll(-2, 1)) - _product(y.roll(-2, 1), one.roll(-1, 1))
    return _product(minors, x).sum(1)


@lru_cache(maxsize=16)
def _angle_grid(dtype: torch.dtype, device: torch.device) -> tuple[Tensor, Tensor]:
    """Angles from -90 to 90 degrees, and (11, angles) sin^k cos^(10 - k) there."""
    angle = torch.linspace(-math.pi / 2, math.pi / 2, _GRID + 1, dtype=dtype, device=device)
    k = torch.arange(11, dtype=dtype, device=device)[:, None]
    return angle, angle.sin() ** k * angle.cos().clamp_min(0.0) ** (10 - k)


def _real_roots(polynomial: Float[Tensor, "B 11"]) -> tuple[Float[Tensor, " R"], Int[Tensor, " R"]]:
    """Real roots of polynomials of degree ten, with the row of each.

    z = tan(angle): sign changes on a grid of angles bracket them, Newton's method with bisection finishes.
    """
    angle, table = _angle_grid(polynomial.dtype, polynomial.device)
    negative = torch.signbit(polynomial @ table)
    row, cell = (negative[:, 1:] != negative[:, :-1]).nonzero().unbind(-1)
    # Beyond 45 degrees in terms of 1/z, whose polynomial has the coefficients in reverse.
    inverse = (cell < _GRID // 4) | (cell >= 3 * _GRID // 4)
    chosen = polynomial[row]
    coefficients = torch.where(inverse[:, None], chosen.flip(-1), chosen).unbind(-1)

    def ends(angle: Tensor) -> Tensor:
        return torch.where(inverse, angle.cos() / angle.sin(), angle.tan())

    low, high = ends(angle[cell]), ends(angle[cell + 1])
    sign = torch.where(negative[row, cell], -1.0, 1.0).to(polynomial.dtype)
    z = 0.5 * (low + high)
    for _ in range(5):  # each about doubles the correct digits
        value, slope = torch.addcmul(coefficients[9], coefficients[10], z), coefficients[10]
        for k in range(8, -1, -1):
            slope = torch.addcmul(value, slope, z)
            value = torch.addcmul(coefficients[k], value, z)
        same = value * sign > 0
        low, high = torch.where(same, z, low), torch.where(same, high, z)
        step = z - value / slope
        inside = (step - low) * (step - high) <= 0
        z = torch.where(inside, step, 0.5 * (low + high))
    return torch.where(inverse, 1 / z, z), row


@full_precision
def essential_from_pose(
    R_21: Float[Tensor, "*#batch 3 3"], t_21: Float[Tensor, "*#batch 3"]
) -> Float[Tensor, "*#batch 3 3"]:
    """Compute essential matrices E = [t]x R."""
    return skew(t_21) @ R_21


@full_precision
def decompose_essential(
    E: Float[Tensor, "*batch 3 3"],
) -> tuple[Float[Tensor, "*batch 2 3 3"], Float[Tensor, "*batch 3"]]:
    """Decompose essential matrices of any scale into R_i and t of unit length: poses (R_i, t) and (R_i, -t).

    Also of a matrix that is none, by noise: the R_i are rotations up to rounding. Without a singular value
    decomposition, so that the gradient is correct at the equal singular values. Source: Horn, "Recovering baseline and
    orientation from essential matrix", 1990.
    """
    R, t = motions_of_essential(E)
    return matrix_from_quaternion(quaternion_from_matrix(R)), t


def motions_of_essential(
    E: Float[Tensor, "*batch 3 3"],
) -> tuple[Float[Tensor, "*batch 2 3 3"], Float[Tensor, "*batch 3"]]:
    """As `decompose_essential`, where the R_i are rotations only as far as E is an essential matrix."""
    gram = E @ E.mT
    half_trace = 0.5 * gram.diagonal(dim1=-2, dim2=-1).sum(-1)
    outer = half_trace[..., None, None] * torch.eye(3, dtype=E.dtype, device=E.device) - gram  # t t^T
    diagonal = outer.diagonal(dim1=-2, dim2=-1)
    largest = diagonal.detach().argmax(-1, keepdim=True)
    pivot = diagonal.gather(-1, largest).clamp_min(torch.finfo(E.dtype).tiny)
    t = outer.gather(-1, largest[..., None].expand(*outer.shape[:-1], 1)).squeeze(-1) * pivot.rsqrt()
    cofactors = torch.linalg.cross(E.roll(-1, -2), E.roll(-2, -2), dim=-1)
    twist = skew(t) @ E
    R = torch.stack((cofactors - twist, cofactors + twist), dim=-3)
    size = (t * t).sum(-1).clamp_min(torch.finfo(E.dtype).tiny)
    return R / size[..., None, None, None], t * size[..., None].rsqrt()


@full_precision
def sampson_errors(
    E: Float[Tensor, "*#batch 3 3"],
    x_1: Float[Tensor, "*#batch N 2"],
    x_2: Float[Tensor, "*#batch N 2"],
    variance_1: Float[Tensor, "*#batch #N"] | float = 1.0,
    variance_2: Float[Tensor, "*#batch #N"] | float = 1.0,
) -> Float[Tensor, "*#batch N"]:
    """Compute signed Sampson distances to the epipolar constraint, zero at both epipoles.

    First-order distances over both images together, in standard deviations of the coordinates, whose variances are
    `variance_1` and `variance_2`. Source: Hartley and Zisserman, "Multiple view geometry", 2004, eq. 11.9.
    """
    x_1, x_2 = homogeneous(x_1), homogeneous(x_2)
    line_2, line_1 = x_1 @ E.mT, x_2 @ E
    squared = line_2[..., :2].square().sum(-1) * variance_2 + line_1[..., :2].square().sum(-1) * variance_1
    regular = squared > torch.finfo(squared.dtype).tiny
    return torch.where(regular, (x_2 * line_2).sum(-1) * torch.where(regular, squared, 1.0).rsqrt(), 0.0)


@full_precision
def epipolar_offsets(
    T_21: Float[Tensor, "*#batch 4 4"],
    pixels_1: Float[Tensor, "*#batch N 2"],
    pixels_2: Float[Tensor, "*#batch N 2"],
    camera_1: Camera,
    camera_2: Camera,
) -> tuple[Float[Tensor, "*#batch N"], Float[Tensor, "*#batch N"]]:
    """Compute the offsets of matches from the epipolar lines of a motion, across and along them.

    Returns:
        The signed Sampson distance and the disparity to a point at infinity, in pixels at the center of camera 2.
        For a point on its line at depth z in camera 2 the disparity is |e| / z, e being the shift along the line by
        one unit of the translation; it is negative behind that camera. Both are zero at the epipole and without a
        translation; the disparity also where infinity is behind camera 2.
    """
    x_1, x_2 = camera_1.normalize(pixels_1), camera_2.normalize(pixels_2)
    R, t = T_21[..., :3, :3], T_21[..., None, :3, 3]
    across = sampson_errors(essential_from_pose(R, T_21[..., :3, 3]), x_1, x_2)
    far = homogeneous(x_1) @ R.mT
    ahead = far[..., 2:] > torch.finfo(far.dtype).eps
    x_far = far[..., :2] / torch.where(ahead, far[..., 2:], 1.0)
    towards = t[..., :2] - t[..., 2:] * x_far
    squared = towards.square().sum(-1)
    regular = ahead[..., 0] & (squared > torch.finfo(squared.dtype).tiny)
    along = ((x_2 - x_far) * towards).sum(-1) * torch.where(regular, squared, 1.0).rsqrt()
    return camera_2.focal * across, camera_2.focal * torch.where(regular, along, 0.0)


@full_precision
def homography_from_matches(
    x_1: Float[Tensor, "*batch N 2"], x_2: Float[Tensor, "*batch N 2"]
) -> Float[Tensor, "*batch 3 3"]:
    """Compute homographies with H_33 = 1 of samples of four or more matches, in the algebraic least-squares sense.

    For samples of more than four, coordinates should be of order one. Degenerate samples (three points on a line) give
    zeros, or anything. Source: Hartley and Zisserman, 2004, alg. 4.1.
    """
    x, y = x_1.unbind(-1)
    zero, one = torch.zeros_like(x), torch.ones_like(x)
    u, v = x_2.unbind(-1)
    row_u = torch.stack((x, y, one, zero, zero, zero, -u * x, -u * y), dim=-1)
    row_v = torch.stack((zero, zero, zero, x, y, one, -v * x, -v * y), dim=-1)
    A, b = torch.cat((row_u, row_v), dim=-2), torch.cat((u, v), dim=-1)[..., None]
    if x_1.shape[-2] > 4:
        A, b = A.mT @ A, A.mT @ b
    h = torch.linalg.solve_ex(A, b)[0].squeeze(-1).nan_to_num()
    return torch.cat((h, torch.ones_like(h[..., :1])), dim=-1).unflatten(-1, (3, 3))


@full_precision
def rotation_from_matches(
    rays_1: Float[Tensor, "*batch 2 3"], rays_2: Float[Tensor, "*batch 2 3"]
) -> Float[Tensor, "*batch 3 3"]:
    """Compute rotations that take two rays to two rays, exact for the first."""

    def frame(rays: Tensor) -> Tensor:
        a, b = rays.unbind(-2)
        normal = torch.linalg.cross(a, b, dim=-1)
        x, z = a / a.norm(dim=-1, keepdim=True), normal / normal.norm(dim=-1, keepdim=True)
        return torch.stack((x, torch.linalg.cross(z, x, dim=-1), z), dim=-1)

    return frame(rays_2) @ frame(rays_1).mT


@full_precision
def transfer_errors(
    H: Float[Tensor, "*#batch 3 3"], x_1: Float[Tensor, "*#batch N 2"], x_2: Float[Tensor, "*#batch N 2"]
) -> Float[Tensor, "*#batch N 2"]:
    """Compute differences H(x_1) - x_2, very large where H takes a point behind the camera."""
    mapped = x_1 @ H[..., :2].mT + H[..., None, :, 2]
    depth = mapped[..., 2:]
    front = depth > torch.finfo(depth.dtype).eps
    return torch.where(front, mapped[..., :2] / torch.where(front, depth, 1.0) - x_2, 1e6)


@full_precision
def decompose_homography(
    H: Float[Tensor, "*batch 3 3"],
) -> tuple[Float[Tensor, "*batch 4 3 3"], Float[Tensor, "*batch 4 3"], Float[Tensor, "*batch 4 3"]]:
    """Decompose homographies into the four motions and planes that explain them, two of which have the scene in front.

    Not differentiable by design. Source: Ma et al., "An invitation to 3-D vision", 2004, section 5.3.3.

    Returns:
        R, t in units of the plane's distance, and unit normals n in the first camera: H ~ R + t n^T. A pure rotation
        has t = 0 and any normal.
    """
    with torch.no_grad():
        H = torch.where(torch.linalg.det(H)[..., None, None] < 0, -H, H)
        squares, V = torch.linalg.eigh((H.mT @ H).nan_to_num())
        middle = squares[..., 1].clamp_min(torch.finfo(H.dtype).tiny)
        H = H * middle.rsqrt()[..., None, None]
        low, high = squares[..., 0] / middle, squares[..., 2] / middle
        v_3, v_2, v_1 = V.unbind(-1)
        # u = a v_1 + b v_3 keeps its length under H; without spread, of a pure rotation, any direction does.
        share = ((1 - low) / (high - low).clamp_min(torch.finfo(H.dtype).eps)).clamp(0.0, 1.0)[..., None]
        a, b = share.sqrt(), (1 - share).sqrt()
        R_1, t_1, n_1 = _motion(H, v_2, a * v_1 + b * v_3)
        R_2, t_2, n_2 = _motion(H, v_2, a * v_1 - b * v_3)
        R, t, n = (
            torch.stack((R_1, R_2), dim=-3),
            torch.stack((t_1, t_2), dim=-2),
            torch.stack((n_1, n_2), dim=-2),
        )
    return torch.cat((R, R), dim=-3), torch.cat((t, -t), dim=-2), torch.cat((n, -n), dim=-2)


def _motion(H: Tensor, v: Tensor, u: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """R, t, n from two orthonormal vectors in the plane whose lengths H keeps."""

    def frame(a: Tensor, b: Tensor) -> Tensor:
        return torch.stack((a, b, torch.linalg.cross(a, b, dim=-1)), dim=-1)

    n = torch.linalg.cross(v, u, dim=-1)
    R = frame((H @ v[..., None]).squeeze(-1), (H @ u[..., None]).squeeze(-1)) @ frame(v, u).mT
    return R, ((H - R) @ n[..., None]).squeeze(-1), n
