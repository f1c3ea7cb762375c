"""Positions on the Earth: latitude and longitude, Earth-centered coordinates, and a local frame of east, north, up.

Geodetic positions are (latitude, longitude, altitude): degrees, degrees and meters above the ellipsoid of WGS84.
Sources: NIMA TR8350.2 (the ellipsoid); B. R. Bowring, "Transformation from spatial to geographical coordinates", 1976.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from torchslam.geometry.lie import rigid, se3_inverse, transform
from torchslam.geometry.precision import full_precision

SEMI_MAJOR = 6378137.0
"""Half of the equatorial diameter, meters (WGS84, by definition)."""
FLATTENING = 1 / 298.257223563
"""How much shorter the axis is than the equatorial diameter, relative (WGS84, by definition)."""
ECCENTRICITY_SQUARED = FLATTENING * (2 - FLATTENING)
"""Of the ellipse through the poles."""


@full_precision
def ecef_from_geodetic(geodetic: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
    """Earth-centered, Earth-fixed coordinates of geodetic positions, meters: z to the north pole, x to longitude 0."""
    latitude, longitude = geodetic[..., 0].deg2rad(), geodetic[..., 1].deg2rad()
    altitude = geodetic[..., 2]
    normal = SEMI_MAJOR / (1 - ECCENTRICITY_SQUARED * latitude.sin().square()).sqrt()
    equatorial = (normal + altitude) * latitude.cos()
    return torch.stack(
        (
            equatorial * longitude.cos(),
            equatorial * longitude.sin(),
            (normal * (1 - ECCENTRICITY_SQUARED) + altitude) * latitude.sin(),
        ),
        dim=-1,
    )


@full_precision
def geodetic_from_ecef(ecef: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
    """Geodetic positions of Earth-centered ones; not on the axis, where the longitude has no value and no gradient."""
    x, y, z = ecef.unbind(-1)
    distance = torch.linalg.vector_norm(ecef[..., :2], dim=-1)
    polar = 1 - FLATTENING  # the ratio of the axes
    second = ECCENTRICITY_SQUARED / (1 - ECCENTRICITY_SQUARED)
    reduced = torch.atan2(z, polar * distance)
    for _ in range(3):  # one is right to a nanometer at the ground, three in orbits too
        latitude = torch.atan2(
            z + second * polar * SEMI_MAJOR * reduced.sin() ** 3,
            distance - ECCENTRICITY_SQUARED * SEMI_MAJOR * reduced.cos() ** 3,
        )
        reduced = torch.atan2(polar * latitude.sin(), latitude.cos())
    below = SEMI_MAJOR * (1 - ECCENTRICITY_SQUARED * latitude.sin().square()).sqrt()
    altitude = distance * latitude.cos() + z * latitude.sin() - below
    return torch.stack((latitude.rad2deg(), torch.atan2(y, x).rad2deg(), altitude), dim=-1)


@full_precision
def ecef_from_local(origin: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 4 4"]:
    """The pose T_fe of the frame of east, north, up at geodetic origins in the Earth-centered, Earth-fixed frame."""
    latitude, longitude = origin[..., 0].deg2rad(), origin[..., 1].deg2rad()
    zero = torch.zeros_like(latitude)
    east = torch.stack((-longitude.sin(), longitude.cos(), zero), dim=-1)
    up = torch.stack(
        (latitude.cos() * longitude.cos(), latitude.cos() * longitude.sin(), latitude.sin()), dim=-1
    )
    axes = torch.stack((east, torch.linalg.cross(up, east, dim=-1), up), dim=-1)
    return rigid(axes, ecef_from_geodetic(origin))


@full_precision
def enu_from_geodetic(
    geodetic: Float[Tensor, "*batch N 3"], origin: Float[Tensor, "*batch 3"]
) -> Float[Tensor, "*batch N 3"]:
    """East, north and up of geodetic positions in the tangent plane at a geodetic origin, meters; float64 is needed."""
    return transform(se3_inverse(ecef_from_local(origin)), ecef_from_geodetic(geodetic))


@full_precision
def geodetic_from_enu(
    positions_e: Float[Tensor, "*batch N 3"], origin: Float[Tensor, "*batch 3"]
) -> Float[Tensor, "*batch N 3"]:
    """Geodetic positions of those in the frame of east, north, up at a geodetic origin; float64 is needed."""
    return geodetic_from_ecef(transform(ecef_from_local(origin), positions_e))
