"""One bundle adjustment of any size: the order of its observations, its local models, and its adjoint.

Frames move along the axes of the world: seen from there, a point that lies at the ray r from the camera moves to first
order as dp = v + omega x r + dX, so that the Hessian C of an observation in its point is also that against v, and
r x C against omega. To second order the rotation adds omega x (omega x r) / 2 + omega x dX.
Rows run along the observations: every operation streams through contiguous memory.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Literal, NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchslam.geometry.camera import Camera
from torchslam.geometry.lie import se3_inverse, skew
from torchslam.geometry.robust import Kernel
from torchslam.optim._core.implicit import Tensors
from torchslam.optim._core.levenberg_marquardt import (
    DAMPING_DOWN,
    DAMPING_UP,
    select_models,
    where_tree,
)
from torchslam.optim._core.linear import LOWER_3X3, inverse_root_3x3, lower_times, upper_times
from torchslam.optim._core.residuals import (
    Expansion,
    Linearization,
    ReprojectionData,
    exact_expansion,
    gauss_newton_expansion,
    linearize,
    newton_expansion,
    rounding_cost,
    variance_factor,
)
from torchslam.optim._core.tangent import cross_entries, retract, rotated
from torchslam.optim.bundle._factors import (
    DepthTerms,
    FactorKind,
    FrameBlocks,
    PointBlocks,
    depth_terms,
    errors_along,
    factor_terms,
    scale_step,
    with_depths,
)
from torchslam.optim.bundle._problem import (
    BundleData,
    BundleEstimate,
    MovingParts,
    PriorTerms,
    gauge_motions,
    open_motions,
    prior_terms,
    stiffness_along,
)
from torchslam.optim.bundle._schur import (
    AT_ONCE,
    MANY_FRAMES,
    BundleTangent,
    FactorizedEquations,
    Marginals,
    NormalEquations,
    Structure,
    build_structure,
    sum_runs,
)

Curvature = Literal["none", "definite", "exact"]
"""As of `factor_terms`."""
_DRIFT, _DRIFT_GAIN, _DRIFT_STEPS = 0.3, 0.01, 10
"""A minimization with factors is given up after this many steps that each lower the cost by less than this share, while
the factors still ask for a scale that differs by this one. Healthy ones reach it in a few steps. Tried at these values
only."""
_NEIGHBORS = 8
"""Frames that count as one where points are ordered by the first and the last of many frames that see them. On
courthouse tiles have a fifth fewer frames than with the exact order, and two adjustments take .91 and .99 of the time.
Tried 1 to 12."""
_INNER_FRAMES = 32
"""Free frames from which on points take steps of their own: parts of a window of few frames do not move against each
other, and it converges in a few steps."""
_INNER_STEPS, _INNER_GAIN = 3, 1e-4
"""Most steps of the points alone after a joint step, and the share of the cost that one must gain to be followed by
another. Three adjustments of office_loop need 147 joint steps without any, 55 with at most one, 29 with three."""
_INNER_STEPS_BACK = 6
"""The same after a joint step that raises the cost, until each point that went back has found a better place: a joint
step takes as long as ten of them. So the rounds and the final adjustment of courthouse need 66 steps in place of 93."""
_RAISED = 1e-8
"""Share of the cost by which it must rise for that: far above rounding, far below what a single point does."""
_HELD, _MOST_HELD = 1e-4, 1e8
"""Least and largest damping of its own that a point has in the next joint step after it went back; while it does not, a
tenth of it with every step. Few points that rays hardly hold step to infinity and back, and promise reductions that
never come: on courthouse three of 7,000 made a coarse adjustment take 17 steps in place of 8. The least was tried at
1e-4, .01 and 1: with larger ones, points that only went too far once are slowed down."""
_LEAST_CURVATURE, _LOOSE = 0.01, 0.3
"""How much of its Gauss-Newton Hessian a point must keep with the kernel's whole curvature for Newton's step to use it,
and below which the point also takes steps of its own. The first: .01, .05 and .3 take 6, 6 and 8 steps where no point
is loose. Of three graphs of 24 frames a point or two are, and without steps of their own they cost up to 40 joint
ones."""
_SMALL_ERROR = 1000.0
"""Mean cost of what factors measure, half a squared standard deviation, up to which Newton's steps leave out the
curvature of their errors: three graphs with a learned odometry, wrong by up to 30 standard deviations, take as many
steps without, in four fifths of the time."""
_OWN_STEPS, _OWN_GAIN, _SHORTEST = 30, 1e-13, 0.1
"""Most of these steps, the share of the cost below which they end, and the least curvature along a step, relative to
Gauss and Newton's: a tenth, since a step ten times as long mostly misses."""


@dataclass(frozen=True)
class SparseLayout:
    """The order in which one bundle adjustment is processed, and what of it moves.

    Attributes:
        observations: rows of the problem's observations that count, in the order of `Structure`
        frame_index: rows of T_cw; point_index: positions in point_order
        point_order: rows of points_w, in the order of `Structure`; point_rank: its inverse
        free_frames: rows of T_cw that move; free_points: in point_order
    """

    observations: Int[Tensor, " O"]
    frame_index: Int[Tensor, " O"]
    point_index: Int[Tensor, " O"]
    point_order: Int[Tensor, " N"]
    point_rank: Int[Tensor, " N"]
    free_frames: Int[Tensor, " K"]
    free_points: Bool[Tensor, " N"]
    structure: Structure


def build_sparse_layout(
    given: BundleData,
    moving: MovingParts,
    joined: Int[Tensor, "M 2"] | None = None,
    free_camera: bool = True,
) -> SparseLayout:
    """Order the observations of one problem that count; factors join pairs of frames."""
    counted, free_frames, free_points = moving
    frame_index, point_index = given.frame_index, given.point_index
    num_points = len(free_points)
    count = int(free_frames.sum())
    slots = torch.where(free_frames, free_frames.cumsum(0) - 1, count)
    rows = counted.nonzero().squeeze(-1)
    rows = rows[torch.argsort(slots[frame_index[rows]], stable=True)]
    frames = frame_index[rows]
    first = torch.full((num_points,), count, device=rows.device)
    first = first.scatter_reduce(0, point_index[rows], slots[frames], "amin")
    last = torch.full_like(first, -1)
    last = last.scatter_reduce(0, point_index[rows], slots[frames], "amax")
    # So that the frames of a tile are few.
    alike = _NEIGHBORS if count > MANY_FRAMES else 1
    point_order = torch.argsort((first // alike) * (count + 2) + last // alike, stable=True)
    point_rank = torch.argsort(point_order)
    points = point_rank[point_index[rows]]
    free = free_frames.nonzero().squeeze(-1)
    if joined is not None:
        joined = slots[joined[free_frames[joined].all(-1)]]
    cameras = given.camera_index[free], given.camera_index[frames], len(given.params)
    structure = build_structure(slots[frames], points, num_points, *cameras, joined, free_camera)
    return SparseLayout(
        rows, frames, points, point_order, point_rank, free, free_points[point_order], structure
    )


def assemble_sparse(
    structure: Structure,
    expansion: Expansion,
    rays_w: Float[Tensor, "3 O"],
    free_points: Bool[Tensor, " N"],
    exact: bool,
) -> NormalEquations:
    """Normal equations of observations in the order of `structure`, for frames that move along the world's axes.

    Args:
        expansion: gradient (3 + n, O) and Hessian (3 + n, 3 + n, O) in the point in the world and the camera
        rays_w: from the observing camera to the point, in the axes of the world
        exact: include the second-order terms of the rotation, for the exact Hessian
    """
    gradient, hessian = expansion
    of_points = torch.cat((hessian[:3, :3].flatten(0, 1), gradient[:3])).mT
    points, pull = structure.sum_by_point(of_points).split((9, 3), dim=1)
    eye = torch.eye(3, dtype=rays_w.dtype, device=rays_w.device)[..., None]
    coupling = rays_w.new_zeros(structure.coupling.size, 6)
    sums = list[list[Tensor]]()
    for run, ends in structure.runs():
        slope, rays, own = gradient[:3, run], rays_w[:, run], hessian[:3, :, run]
        # The columns of all blocks: against points, the gradient, against the camera.
        own = torch.cat((own[:, :3], slope[:, None], own[:, 3:]), dim=1)
        rotated = torch.stack(cross_entries(rays, own))
        twice = torch.stack(cross_entries(rays, rotated[:, :3].transpose(0, 1)))
        against_points = rotated[:, :3]
        if exact:
            against_points = against_points - torch.stack(cross_entries(slope, eye))
            outer = slope[:, None] * rays
            twice = twice + 0.5 * (outer + outer.transpose(0, 1)) - outer.diagonal().sum(-1) * eye
        blocks = torch.cat((own[:, :3], against_points)).permute(2, 1, 0)
        structure.coupling.add(coupling, blocks, run.start)
        sums.append([sum_runs(values, ends) for values in (own, rotated, twice)])
    moved, rotated, twice = (torch.cat(parts) for parts in zip(*sums, strict=True))
    upper = torch.cat((moved[..., :3], rotated[..., :3].mT), dim=-1)
    lower = torch.cat((rotated[..., :3], twice), dim=-1)
    rest = torch.cat((moved[..., 3:], rotated[..., 3:]), dim=1)
    of_cameras = tuple(gradient.new_zeros(len(structure.camera_ends), *(0,) * n) for n in (1, 2))
    camera_coupling = coupling[:0, :0]
    if len(gradient) > 3:
        of_cameras = tuple(structure.sum_by_camera(x) for x in (gradient[3:], hessian[3:, 3:]))
        of_pairs = structure.sum_by_pair(hessian[:3, 3:].permute(2, 0, 1))
        camera_coupling = structure.camera_coupling.stored(of_pairs)
    return NormalEquations(
        structure,
        BundleTangent(rest[..., 0], pull, of_cameras[0]),
        torch.cat((upper, lower), dim=1),
        points.unflatten(-1, (3, 3)),
        of_cameras[1],
        rest[..., 1:],
        coupling,
        camera_coupling,
        free_points,
    )


def product(A: Float[Tensor, "m 3 O"], B: Float[Tensor, "3 n O"]) -> Float[Tensor, "m n O"]:
    """A B of matrices whose last dimension runs along the observations."""
    first = A[:, 0, None] * B[0]
    return first.addcmul(A[:, 1, None], B[1]).addcmul(A[:, 2, None], B[2])


@dataclass(frozen=True)
class SparseModel:
    """The local model of the cost at an estimate; its equations are assembled on first use: the last model of a
    minimization never needs them, and they are most of the work."""

    estimate: BundleEstimate
    cost: Float[Tensor, " 1"]
    terms: PriorTerms | None
    assembled: Callable[[], NormalEquations]
    assembled_newton: Callable[[], tuple[NormalEquations, Tensor]] | None = None

    @cached_property
    def equations(self) -> NormalEquations:
        return self.assembled()

    @cached_property
    def newton(self) -> tuple[NormalEquations, Bool[Tensor, " N"]] | None:
        """The equations with the kernel's whole curvature, and the points for which a step by them may be too long;
        None far from the minimum."""
        return None if self.assembled_newton is None else self.assembled_newton()


_ALL = slice(None)
EXACT_AT_ONCE = 1 << 14
"""Observations of which second derivatives are computed at once, 130 MB. All 81,000 of garden at once take 950 MB, and
as long."""


def runs_of(count: int, size: int) -> list[slice]:
    """Runs of `size` of `count` observations; one where there are none."""
    return [slice(start, start + size) for start in range(0, max(count, 1), size)]


class Seen(NamedTuple):
    """Per observation the rotation (3, 3, O') of its frame, and the ray to its point: (3, O') in the axes of the world
    and (O', 3) in those of the camera."""

    R_cw: Tensor
    rays_w: Tensor
    points_c: Tensor


class SparseBundle:
    """A bundle adjustment for `minimize_batch` (a batch of one), with its covariances and exact solver."""

    def __init__(
        self,
        layout: SparseLayout,
        given: BundleData,
        camera: Camera,
        kernel: Kernel,
        directions: Tensor | None,
        kinds: Sequence[FactorKind],
        newton: bool = False,
        concludes: bool = False,
    ) -> None:
        """given: of one problem; directions: (P, n) in which the parameters move, None where they stay; kinds: of
        factors; newton: whether to end with steps of Newton; concludes: as of `Concluding`"""
        self.concludes = concludes
        self.kinds = [kind._replace(points=layout.point_rank[kind.points]) for kind in kinds]
        self.drift_steps = 0  # in a row
        self.own_damping = torch.zeros_like(given.points_w[:, 0])  # of points that joint steps moved too far
        self.layout, self.given, self.directions = layout, given, directions
        self.camera, self.kernel = camera, kernel
        rows = layout.observations
        self.camera_of: Tensor | None = None  # where there are several, of each observation
        if len(given.params) > 1:
            self.camera_of = given.camera_of.index_select(0, rows)
        self.pixels, self.weights = given.pixels.index_select(0, rows), given.weights.index_select(0, rows)
        self.observations = self._observed(given.params, _ALL)
        self.start = BundleEstimate(
            given.T_cw, given.points_w.index_select(0, layout.point_order), given.params
        )
        self.depths: tuple[Tensor, Tensor] | None = None
        if len(given.depths):
            information = given.depth_information.index_select(0, rows)
            self.depths = given.depths.index_select(0, rows), information
        self.runs = runs_of(len(rows), AT_ONCE)
        self.has_newton = newton and len(self.runs) == 1  # needs the Hessians of all observations at once
        self.slots = torch.full_like(given.camera_index, -1)  # of each frame among those that are free
        self.slots[layout.free_frames] = torch.arange(len(layout.free_frames), device=self.slots.device)
        self.inner_points = layout.free_points  # that may take steps of their own
        for kind in self.kinds:
            self.inner_points = self.inner_points.index_fill(0, kind.points.flatten(), False)
        has_prior = (given.pose_prior is not None or len(kinds) > 0) and len(layout.free_frames) > 0
        self.solvable = torch.tensor([len(rows) > 0 or has_prior], device=given.pixels.device)

    def rounding(self) -> Tensor:
        weights = self.given.weights
        if self.observations.has_matrices:
            weights = weights.diagonal(dim1=-2, dim2=-1)
        return rounding_cost(weights[None], self.given.params[None])

    def evaluate(self, estimate: BundleEstimate, use_curvature: Tensor) -> SparseModel:
        curvature: Curvature = "definite" if bool(use_curvature.any()) else "none"
        terms, costs, of_depths = self._priors(estimate, curvature, near=True), list[Tensor](), list[Tensor]()
        for run in self.runs:
            seen, lin = found = self._linearized(estimate, run)
            costs.append(lin.cost)
            if self.depths is not None:
                of_depths.append(self._depth_terms(seen, run).cost)
        kept = found if len(self.runs) == 1 else None  # else they would take most of the memory
        cost = torch.cat(costs).sum() if terms is None else torch.cat(costs).sum() + terms.cost
        if of_depths:
            cost = cost + torch.cat(of_depths).sum()
        newton = None
        if self.has_newton and kept is not None and curvature == "definite":
            newton = partial(self._newton_equations, kept, terms)
        return SparseModel(
            estimate,
            cost[None],
            terms,
            lambda: _with_priors(self._equations(estimate, use_curvature, kept=kept), terms),
            newton,
        )

    def step(self, model: SparseModel, damping: Tensor) -> tuple[BundleEstimate, Tensor]:
        estimate, gauge = model.estimate, self._gauge(model.estimate, model.terms)
        loose: Tensor | None = None
        if model.newton is not None:
            equations, loose = model.newton
            factorized = equations.factorized(damping, gauge)
        if model.newton is None or not bool(factorized.definite):
            equations, loose = model.equations, None
            factorized = equations.factorized(damping, gauge, self.own_damping)
        step = factorized.solve(equations.gradient)
        predicted_reduction = torch.where(factorized.definite, 0.5 * step.dot(equations.gradient), torch.inf)
        frames = self.layout.free_frames
        T_free = estimate.T_cw.index_select(0, frames)
        T_free = retract(T_free, -rotated(T_free[:, :3, :3], step.frames[..., None])[..., 0])
        params = estimate.params
        if self.directions is not None:
            params = params - step.cameras @ self.directions.mT
        moved = BundleEstimate(
            estimate.T_cw.index_copy(0, frames, T_free), estimate.points_w - step.points, params
        )
        moved = self._settled(moved, model) if loose is None else self._settled_alone(moved, model, loose)
        return moved, predicted_reduction[None]

    def _settled(self, estimate: BundleEstimate, model: SparseModel) -> BundleEstimate:
        """The estimate with each point moved on to where its own cost is lower, by up to `_INNER_STEPS` steps.

        With the frames fixed, points are independent problems, each with a damping and a decision of its own. What is
        left of a joint step then follows the curved valley along which a part of a map moves against another. Where the
        joint step raises the cost, points start from where they were before it if that is better, and take more steps:
        a single point that steps too far does not stop all others. The next joint step moves it less.
        Source: Jeong et al., "Pushing the envelope of modern methods for bundle adjustment", 2012, section 4.
        """
        if len(self.layout.free_frames) < _INNER_FRAMES or not self.inner_points.any():
            return estimate
        damping = torch.full_like(estimate.points_w[:, 0], 1e-4)
        now, steps = self._of_points(estimate), _INNER_STEPS
        returned = torch.zeros_like(damping, dtype=torch.bool)
        if bool(now[0].sum() > (1 + _RAISED) * model.cost):
            before = estimate._replace(points_w=model.estimate.points_w)
            then, steps = self._of_points(before), _INNER_STEPS_BACK
            returned = (then[0] < now[0]) & self.inner_points
            now = tuple(torch.where(returned, one, other) for one, other in zip(then, now, strict=True))
            points_w = torch.where(returned[:, None], before.points_w, estimate.points_w)
            estimate = estimate._replace(points_w=points_w)
        self.own_damping = torch.where(
            returned,
            (DAMPING_UP * self.own_damping).clamp(_HELD, _MOST_HELD),
            DAMPING_DOWN * self.own_damping,
        )
        for _ in range(steps):
            moved = estimate.points_w - self._point_steps(now[1], now[2], damping)
            found = self._of_points(estimate._replace(points_w=moved))
            better = found[0] < now[0]
            gain = torch.where(better, now[0] - found[0], 0.0).sum()
            points_w = torch.where(better[:, None], moved, estimate.points_w)
            estimate = estimate._replace(points_w=points_w)
            returned = returned & ~better
            if bool(gain < _INNER_GAIN * now[0].sum()) and not returned.any():
                break
            now = tuple(torch.where(better, one, other) for one, other in zip(found, now, strict=True))
            damping = torch.where(better, 0.1 * damping, 100 * damping)
        return estimate

    def _settled_alone(self, estimate: BundleEstimate, model: SparseModel, loose: Tensor) -> BundleEstimate:
        """The estimate with each of the loose points moved on to a minimum of its own cost.

        Such a point is about to leave one minimum for another one, along a direction in which its cost is nearly flat
        or curved downward: the step along it has the length of one of a convex function with as much curvature.
        Source: Dauphin et al., "Identifying and attacking the saddle point problem", 2014.
        """
        numbers = (loose & self.inner_points).nonzero().squeeze(-1)
        if not len(numbers):
            return estimate
        point_index = self.layout.point_index
        rows = loose.index_select(0, point_index) & self.inner_points.index_select(0, point_index)
        rows = rows.nonzero().squeeze(-1)
        places = torch.searchsorted(numbers, point_index.index_select(0, rows))

        def at(points: Tensor) -> tuple[Tensor, ...]:
            """Costs (n,), steps (n, 3) to take away, and what they gain (n,)."""
            moved = estimate._replace(points_w=estimate.points_w.index_copy(0, numbers, points))
            seen, observed = self._seen(moved, rows), self._observed(estimate.params, rows)
            lin = linearize(observed, seen.points_c)
            J, cost = product(lin.J.movedim(0, -1), seen.R_cw), lin.cost
            flat = gauss_newton_expansion(lin, J, self.solvable.new_ones(1))
            whole = newton_expansion(lin, J)
            if self.depths is not None:
                terms = self._depth_terms(seen, rows)
                flat, whole = (with_depths(each, terms, seen.R_cw[2]) for each in (flat, whole))
                cost = cost + terms.cost
            every = torch.cat(
                (cost[None], flat.gradient, *(each.hessian.flatten(0, 1) for each in (flat, whole)))
            )
            sums = every.new_zeros(len(numbers), len(every)).index_add(0, places, every.mT)
            cost, gradient, blocks, curved = sums.split((1, 3, 9, 9), dim=1)
            step = _newton_steps(gradient, blocks.unflatten(1, (3, 3)), curved.unflatten(1, (3, 3)))
            return cost[:, 0], step, 0.5 * (step * gradient).sum(1)

        points, least = estimate.points_w.index_select(0, numbers), _OWN_GAIN * model.cost
        now = at(points)
        if bool(now[2].sum() <= least):
            return estimate
        before = model.estimate.points_w.index_select(0, numbers)
        then = at(before)
        is_back = then[0] < now[0]
        points = torch.where(is_back[:, None], before, points)
        now = where_tree(is_back, then, now)
        share = torch.ones_like(now[0])
        for _ in range(_OWN_STEPS):
            moved = points - share[:, None] * now[1]
            found = at(moved)
            better = found[0] < now[0]
            points = torch.where(better[:, None], moved, points)
            now = where_tree(better, found, now)
            share = torch.where(better, (4 * share).clamp_max(1), 0.25 * share)
            if bool((share * now[2]).sum() <= least):
                break
        return estimate._replace(points_w=estimate.points_w.index_copy(0, numbers, points))

    def _of_points(self, estimate: BundleEstimate) -> tuple[Tensor, ...]:
        """The cost (N,) of each point's observations, and its gradient (3, N) and Gauss-Newton Hessian (3, 3, N)."""
        every = estimate.points_w.new_empty(len(self.layout.observations), 13)
        for run in self.runs:
            seen = self._seen(estimate, run)
            lin = linearize(self._observations(estimate, run), seen.points_c)
            J = product(lin.J.movedim(0, -1), seen.R_cw)
            expansion = gauss_newton_expansion(lin, J, torch.zeros_like(self.solvable))
            cost = lin.cost
            if self.depths is not None:
                terms = self._depth_terms(seen, run)
                expansion, cost = with_depths(expansion, terms, seen.R_cw[2]), cost + terms.cost
            parts = cost[None], expansion.gradient, expansion.hessian.flatten(0, 1)
            every[run] = torch.cat(parts).mT
        sums = self.layout.structure.sum_by_point(every).mT
        return sums[0], sums[1:4], sums[4:].unflatten(0, (3, 3))

    def _point_steps(
        self, gradient: Float[Tensor, "3 N"], hessian: Float[Tensor, "3 3 N"], damping: Float[Tensor, " N"]
    ) -> Float[Tensor, "N 3"]:
        """What to subtract from the points, zero where they are fixed or not determined."""
        grown = [hessian[row, column] * (1 + damping * (row == column)) for row, column in LOWER_3X3]
        root = inverse_root_3x3(grown, self.inner_points)
        return torch.stack(upper_times(root, lower_times(root, gradient)), dim=-1)

    def drifts(self, old: SparseModel, new: SparseModel, relative_reduction: Tensor) -> Tensor:
        """Whether factors shrink or grow the map without end: a plane that the camera does not keep is kept best by a
        map without extent.

        Images do not depend on the scale, so that the factors alone ask for it: by the step of Gauss and Newton in all
        motions of the world. At a minimum it is zero, and for a map without extent always one.
        """
        step, first_to_end = 0.0, self._open_motions[:2]
        if self.kinds and first_to_end in ((0, 1), (0, 7)) and float(relative_reduction) < _DRIFT_GAIN:
            motions = self._motions(new.estimate)
            assert motions is not None
            assert new.terms is not None
            step = scale_step(*self._along(new.terms, *motions))
        self.drift_steps = self.drift_steps + 1 if abs(step) > _DRIFT else 0
        return torch.full_like(self.solvable, self._has_drifted)

    def _along(self, terms: PriorTerms, of_frames: Tensor, of_points: Tensor) -> tuple[Tensor, Tensor]:
        """`errors_along` motions of the free frames (K', 6, g) and of the points (N, 3, g)."""
        frames = of_frames.new_zeros(len(self.given.T_cw), *of_frames.shape[1:])
        frames = frames.index_copy(0, self.layout.free_frames, of_frames)
        return errors_along(terms.errors, frames, of_points * self.layout.free_points[:, None, None])

    @property
    def _has_drifted(self) -> bool:
        return self.drift_steps >= _DRIFT_STEPS

    select = staticmethod(select_models)

    def concluded(self, model: SparseModel, estimate: BundleEstimate) -> SparseModel:
        return replace(model, estimate=estimate, assembled=lambda: model.equations)

    def definite(self, model: SparseModel) -> Tensor:
        """Whether (1,) all that moves is determined, up to the gauge."""
        if self._has_drifted:
            return torch.zeros_like(self.solvable)
        return model.equations.factorized(gauge=self._gauge(model.estimate, model.terms)).definite[None]

    def ordered(self, estimate: BundleEstimate) -> BundleEstimate:
        """The estimate of a batch of one in the layout's order."""
        T_cw, points_w, params = (part[0] for part in estimate)
        return BundleEstimate(T_cw, points_w.index_select(0, self.layout.point_order), params)

    def in_order(self, estimate: BundleEstimate) -> BundleEstimate:
        """The estimate of the layout's order as that of a batch of one, in the order of the problem."""
        points_w = estimate.points_w.index_select(0, self.layout.point_rank)
        return BundleEstimate(estimate.T_cw[None], points_w[None], estimate.params[None])

    @cached_property
    def _open_motions(self) -> tuple[int, int, int]:
        """The first motion of a similarity, of which the scale is the first, that observations and what is fixed allow,
        the one after the last, and the frame that the scale is about."""
        layout = self.layout
        is_anchor = torch.zeros_like(self.slots, dtype=torch.bool)
        is_anchor[layout.frame_index] = True
        is_anchor[layout.free_frames] = False
        anchors = is_anchor.nonzero().flatten().tolist()
        fixed_points = ~layout.free_points & (layout.structure.by_point.counts > 0)
        if len(anchors) > 1 or fixed_points.any() or not len(layout.free_frames):
            return 0, 0, 0
        has_depths = self.depths is not None and bool((self.depths[1] > 0).any())  # which hold the scale
        return int(has_depths), 1 if anchors else 7, anchors[0] if anchors else int(layout.free_frames[0])

    def _motions(self, estimate: BundleEstimate) -> tuple[Tensor, Tensor] | None:
        """How free frames (K', 6, g) and points (N, 3, g) move with the world, as far as observations and what is fixed
        allow: its scale, all motions of a similarity, or the rigid ones; None where the gauge is fixed.

        In the axes of the world, as are all vectors of the equations.
        """
        first, end, origin_frame = self._open_motions
        if first == end:
            return None
        T_free, origin = (
            estimate.T_cw[self.layout.free_frames],
            se3_inverse(estimate.T_cw[origin_frame])[:3, 3],
        )
        moved = gauge_motions(T_free, origin), _moved_with_gauge(estimate.points_w, origin)
        return moved[0][..., first:end], moved[1][..., first:end]

    def _gauge(self, estimate: BundleEstimate, terms: PriorTerms | None = None) -> Tensor | None:
        """Gauge directions (K', 6, g): those of `_motions` that priors and factors leave open, orthonormal.

        terms: of `_priors`, if they are known, without the exact Hessian of priors
        """
        every = self._motions(estimate)
        if every is None:
            return None
        of_frames, of_points = every
        motions = torch.linalg.qr(of_frames.flatten(0, 1)).Q.unflatten(0, (-1, 6))
        with torch.no_grad():
            terms = self._priors(estimate) if terms is None else terms
            if terms is None:
                return motions
            held = stiffness_along(motions, terms.frames if terms.of_priors is None else terms.of_priors)
            if terms.errors:
                mixed = torch.linalg.lstsq(of_frames.flatten(0, 1), motions.flatten(0, 1)).solution
                held = held + self._along(terms, motions, of_points @ mixed)[1]
            return open_motions(motions, held)

    def _priors(
        self, estimate: BundleEstimate, curvature: Curvature = "none", near: bool = False
    ) -> PriorTerms | None:
        """What priors on free frames (K') and cameras, and factors, add, in the axes of the world.

        near: leave the curvature of small errors to Newton's steps, which are as many without
        """
        frames, given = self.layout.free_frames, self.given
        if not given.has_priors and not self.kinds:
            return None
        if given.pose_prior is not None:
            T_cw, information = (
                x.index_select(0, frames) for x in (given.prior_T_cw, given.prior_information)
            )
            given = given._replace(prior_T_cw=T_cw, prior_information=information)
        T_cw = estimate.T_cw.index_select(0, frames)
        moving = torch.ones_like(frames).bool()
        terms = prior_terms(given, T_cw, estimate.params, moving, self.directions, curvature == "exact")
        terms = terms.in_world(T_cw[:, :3, :3])
        return self._with_factors(terms, estimate, curvature, near) if self.kinds else terms

    def _with_factors(
        self, terms: PriorTerms, estimate: BundleEstimate, curvature: Curvature, near: bool
    ) -> PriorTerms:
        """The terms with those of the factors; what belongs to frames and points that stay is left out."""
        frames, given, directions = self.layout.free_frames, self.given, self.directions
        if directions is None:
            directions = given.params.new_zeros(given.params.shape[1], 0)
        flat = near and self.has_newton and curvature == "definite"
        terms_of = partial(
            factor_terms, self.kinds, estimate, given.measured, given.factor_information, directions
        )
        found = terms_of("none" if flat else curvature)
        if flat and float(found.cost) > _SMALL_ERROR * len(given.measured):
            found = terms_of(curvature)
        slots = self.slots
        first, second, blocks = found.between
        joined = (slots[first] >= 0) & (slots[second] >= 0)
        points = found.points
        if points is not None:
            numbers, split, width = points.joined, 6 * len(slots), 6 * len(frames)
            of_frames = 6 * slots[torch.where(numbers < split, numbers, 0) // 6] + numbers % 6
            points_free = self.layout.free_points[(numbers - split).clamp_min(0) // 3]
            stays = torch.where(numbers < split, of_frames < 0, ~points_free)
            numbers = torch.where(numbers < split, of_frames, numbers - split + width)[~stays]
            points = PointBlocks(*points[:2], numbers, points.matrix[~stays][:, ~stays])
        return terms._replace(
            cost=terms.cost + found.cost,
            frames_gradient=terms.frames_gradient + found.frames_gradient[frames],
            frames=terms.frames + found.frames[frames],
            cameras_gradient=terms.cameras_gradient + found.camera_gradient,
            cameras=terms.cameras + found.camera,
            between=FrameBlocks(slots[first[joined]], slots[second[joined]], blocks[joined]),
            points=points,
            errors=found.errors,
            of_priors=terms.frames,
        )

    def marginals(self, estimate: BundleEstimate) -> Marginals:
        """Covariances (1, K, 6, 6), (1, N, 3, 3), (1, C n, C n) in the order of the problem, zero for what stays."""
        estimate = self.ordered(estimate)
        everything = self._linearized(estimate, slice(None))
        layout, structure = self.layout, self.layout.structure
        num_cameras = 0 if self.directions is None else len(estimate.params) * self.directions.shape[1]
        num_parameters = 6 * structure.num_frames + 3 * int(layout.free_points.sum()) + num_cameras
        factor = variance_factor(self.observations, everything[1], num_parameters)
        # Priors, depths and factors are in absolute units, which the residuals do not calibrate.
        equations = self._equations(estimate, torch.zeros_like(self.solvable), factor, everything)
        equations = _with_priors(equations, self._priors(estimate), share=factor)
        free, points, camera = equations.factorized(gauge=self._gauge(estimate)).marginals()
        R_cw = estimate.T_cw[layout.free_frames, :3, :3]
        free = rotated(R_cw, rotated(R_cw, free).mT)
        frames = free.new_zeros(len(estimate.T_cw), 6, 6).index_copy(0, layout.free_frames, free)
        blocks = factor * frames, factor * points[layout.point_rank], factor * camera
        return Marginals(*(block[None] for block in blocks))

    def linear_system(
        self, estimate: BundleEstimate
    ) -> tuple[Linearization, Float[Tensor, "2 m O"], Float[Tensor, "3 O"], FactorizedEquations]:
        """Linearize the observations alone at an estimate in the layout's order: residuals, their derivatives in the
        point and the camera, the rays from frames to points, in the axes of the world, and the factorized equations."""
        seen, lin = everything = self._linearized(estimate, slice(None))
        equations = self._equations(estimate, torch.zeros_like(self.solvable), kept=everything)
        J = self._in_world(lin.J.movedim(0, -1), seen.R_cw)
        return lin, J, seen.rays_w, equations.factorized(gauge=self._gauge(estimate))

    def exact_solver(self, estimate: BundleEstimate) -> Callable[[Tensors], Tensors]:
        """v -> H^-1 v with the exact Hessian at a minimum, for a batch of one in the order of the problem."""
        layout, ordered = self.layout, self.ordered(estimate)
        exact = self._exact_equations(ordered).factorized(gauge=self._gauge(ordered))
        R_cw = ordered.T_cw[layout.free_frames, :3, :3]

        def solve(right: Tensors) -> Tensors:
            frames, points, cameras = (part[0] for part in right)
            cameras = cameras.view(len(ordered.params), -1)
            free = rotated(R_cw.mT, frames.index_select(0, layout.free_frames)[..., None])[..., 0]
            solved = exact.solve(BundleTangent(free, points.index_select(0, layout.point_order), cameras))
            free = rotated(R_cw, solved.frames[..., None])[..., 0]
            spread = torch.zeros_like(frames).index_copy(0, layout.free_frames, free)
            vector = spread, solved.points.index_select(0, layout.point_rank), solved.cameras.flatten()
            return tuple(part[None] for part in vector)

        return solve

    def _seen(self, estimate: BundleEstimate, run: slice | Tensor = _ALL) -> Seen:
        R_cw = estimate.T_cw[:, :3, :3]
        centers_w = -(R_cw.mT @ estimate.T_cw[:, :3, 3:])
        frames = torch.cat((R_cw.flatten(1), centers_w[..., 0]), dim=-1)
        rows = frames.index_select(0, self.layout.frame_index[run]).mT.contiguous()
        R_cw = rows[:9].unflatten(0, (3, 3))
        rays_w = estimate.points_w.index_select(0, self.layout.point_index[run]).mT - rows[9:]
        return Seen(R_cw, rays_w, product(R_cw, rays_w[:, None])[:, 0].mT)

    def _linearized(self, estimate: BundleEstimate, run: slice) -> tuple[Seen, Linearization]:
        seen, is_free = self._seen(estimate, run), self.directions is not None
        return seen, linearize(self._observations(estimate, run), seen.points_c, is_free)

    def _in_world(self, rows: Tensor, R_cw: Tensor) -> Tensor:
        """Derivatives (m, 3 + P, O') in points_c and the camera, as such in points_w and what moves of the camera."""
        points = product(rows[:, :3], R_cw)
        if self.directions is None:
            return points
        return torch.cat((points, self.directions.mT @ rows[:, 3:]), dim=1)

    def _observed(self, params: Tensor, run: slice | Tensor) -> ReprojectionData:
        camera = self.camera.with_params(params)
        camera = camera[0] if self.camera_of is None else camera[self.camera_of[run]]
        return ReprojectionData(self.pixels[run], self.weights[run], camera, self.kernel, self.given.scale)

    def _observations(self, estimate: BundleEstimate, run: slice = _ALL) -> ReprojectionData:
        if self.directions is None and len(self.runs) == 1:
            return self.observations
        return self._observed(estimate.params, run)

    def _equations(
        self,
        estimate: BundleEstimate,
        use_curvature: Tensor,
        share: Tensor | float = 1.0,
        kept: tuple[Seen, Linearization] | None = None,
    ) -> NormalEquations:
        """Without the curvature of the projection, and without priors; with a share of the depths.

        kept: `_linearized` of all observations, if it is known
        """

        def expanded(run: slice) -> tuple[Seen, Expansion]:
            seen, lin = kept or self._linearized(estimate, run)
            J = self._in_world(lin.J.movedim(0, -1), seen.R_cw)
            expansion = gauss_newton_expansion(lin, J, use_curvature)
            if self.depths is not None:
                expansion = with_depths(expansion, self._depth_terms(seen, run, share), seen.R_cw[2])
            return seen, expansion

        return self._assembled(self.runs if kept is None else [_ALL], expanded, exact=False)

    def _newton_equations(
        self, kept: tuple[Seen, Linearization], terms: PriorTerms | None
    ) -> tuple[NormalEquations, Bool[Tensor, " N"]]:
        """As `_equations` with priors, and with the kernel's whole curvature for points whose blocks it leaves
        positive definite; the points of which it leaves little.

        The curvature of the projection is left out here, too: it changes no count of steps.
        """
        (seen, lin), structure = kept, self.layout.structure
        J = self._in_world(lin.J.movedim(0, -1), seen.R_cw)
        flat = gauss_newton_expansion(lin, J, self.solvable.new_ones(1))
        whole = newton_expansion(lin, J)
        if self.depths is not None:
            of_depths = self._depth_terms(seen, _ALL)
            flat, whole = (with_depths(each, of_depths, seen.R_cw[2]) for each in (flat, whole))
        every = torch.cat([each.hessian[:3, :3].flatten(0, 1) for each in (flat, whole)]).mT
        blocks, curved = structure.sum_by_point(every).unflatten(1, (2, 3, 3)).unbind(1)
        keeps = [
            torch.linalg.cholesky_ex(curved - least * blocks)[1] == 0 for least in (_LEAST_CURVATURE, _LOOSE)
        ]
        used = keeps[0].index_select(0, self.layout.point_index)
        expansion = whole._replace(hessian=torch.where(used, whole.hessian, flat.hessian))
        equations = self._assembled([_ALL], lambda run: (seen, expansion), exact=True)
        return _with_priors(equations, terms), ~keeps[1]

    def _assembled(
        self, runs: Sequence[slice], expanded: Callable[[slice], tuple[Seen, Expansion]], exact: bool
    ) -> NormalEquations:
        """The equations of the observations, which are expanded in runs."""
        layout, size = self.layout, 3 + (0 if self.directions is None else self.directions.shape[1])
        if len(runs) == 1:
            seen, expansion = expanded(runs[0])
            expansion, rays_w = Expansion(*(x.contiguous() for x in expansion)), seen.rays_w.contiguous()
            return assemble_sparse(layout.structure, expansion, rays_w, layout.free_points, exact)
        gradient = self.start.points_w.new_empty(size, len(layout.observations))
        hessian, rays_w = gradient.new_empty(size, *gradient.shape), torch.empty_like(gradient[:3])
        for run in runs:
            seen, (gradient[:, run], hessian[..., run]) = expanded(run)
            rays_w[:, run] = seen.rays_w
        expansion = Expansion(gradient, hessian)
        return assemble_sparse(layout.structure, expansion, rays_w, layout.free_points, exact)

    def _depth_terms(
        self, seen: Seen, run: slice | Tensor, share: Tensor | float = 1.0, exact: bool = False
    ) -> DepthTerms:
        assert self.depths is not None
        depths, information = self.depths
        return depth_terms(depths[run], share * information[run], seen.points_c[:, 2], exact)

    def _exact_equations(self, estimate: BundleEstimate) -> NormalEquations:
        def expanded(run: slice) -> tuple[Seen, Expansion]:
            seen, observations = self._seen(estimate, run), self._observed(estimate.params, run)
            gradient, hessian = exact_expansion(observations, seen.points_c, self.directions is not None)
            half = self._in_world(hessian.movedim(0, -1), seen.R_cw).transpose(0, 1)
            gradient = self._in_world(gradient.mT[None], seen.R_cw)[0]
            expansion = Expansion(gradient, self._in_world(half, seen.R_cw))
            if self.depths is not None:
                expansion = with_depths(expansion, self._depth_terms(seen, run, exact=True), seen.R_cw[2])
            return seen, expansion

        equations = self._assembled(runs_of(len(self.pixels), EXACT_AT_ONCE), expanded, exact=True)
        return _with_priors(equations, self._priors(estimate, "exact"))


def _newton_steps(
    gradient: Float[Tensor, "n 3"], blocks: Float[Tensor, "n 3 3"], curved: Float[Tensor, "n 3 3"]
) -> Float[Tensor, "n 3"]:
    """|curved|^-1 gradient, with the absolute values, at least `_SHORTEST`, of its eigenvalues relative to the positive
    definite blocks; zero where these are not."""
    lower, failed = torch.linalg.cholesky_ex(blocks)
    is_definite = failed == 0
    eye = torch.eye(3, dtype=blocks.dtype, device=blocks.device)
    lower = torch.where(is_definite[:, None, None], lower, eye)
    half = torch.linalg.solve_triangular(lower, curved, upper=False)
    relative = torch.linalg.solve_triangular(lower, half.mT, upper=False)
    values, vectors = torch.linalg.eigh(0.5 * (relative + relative.mT))
    right = torch.linalg.solve_triangular(lower, gradient[..., None], upper=False)
    right = vectors @ ((vectors.mT @ right) / values.abs().clamp_min(_SHORTEST)[..., None])
    step = torch.linalg.solve_triangular(lower.mT, right, upper=True).squeeze(-1)
    return torch.where(is_definite[:, None], step, 0.0)


def _moved_with_gauge(
    points_w: Float[Tensor, "N 3"], origin_w: Float[Tensor, " 3"]
) -> Float[Tensor, "N 3 7"]:
    """How points move with the frames of `gauge_motions`."""
    eye = torch.eye(3, dtype=points_w.dtype, device=points_w.device).expand(len(points_w), 3, 3)
    return torch.cat(((points_w - origin_w)[..., None], eye, -skew(points_w)), dim=-1)


def _with_priors(
    equations: NormalEquations, terms: PriorTerms | None, share: Tensor | float = 1.0
) -> NormalEquations:
    """The equations with a share of the priors added."""
    if terms is None:
        return equations
    frames, points, cameras = equations.gradient
    between = terms.between
    if between is not None:
        between = between._replace(blocks=share * between.blocks)
    joined, blocks = terms.points, equations.points
    if joined is not None:
        points, blocks = points + joined.gradient, blocks + share * joined.diagonal
        joined = joined._replace(matrix=share * joined.matrix)
    return replace(
        equations,
        gradient=BundleTangent(frames + terms.frames_gradient, points, cameras + terms.cameras_gradient),
        between=between,
        joined=joined,
        points=blocks,
        frames=equations.frames + share * terms.frames,
        cameras=equations.cameras + share * terms.cameras,
    )
