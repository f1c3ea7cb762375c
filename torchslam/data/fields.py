"""Fields of positions, speeds and inertial samples: their names, their units, and what devices write if unknown.

Every format looks a field up here, a table by its headings and the others for the values that stand for an unknown one.
"""

from __future__ import annotations

import math

from torchslam.data.tables import TIMES, Column, Unknown

NINES = [sign * (10**n - 10**-k) for sign in (1, -1) for n in range(2, 6) for k in range(min(4, 7 - n))]
"""99.99 and -9999: fields filled with nines, as of NMEA's dilution, netCDF and terrain models. At most six of them, or
they would be powers of ten in another unit, rounded."""
LIMITS = [-32768, 32767, 65535, 655.35, 65.535, -(2**31), 2**31 - 1, 2**32 - 1, 214.7483647, -214.7483648]
"""Largest integers: MAVLink's and FIT's invalid ones, also in cm and mm; the last ones in 1e-7 degrees."""


def spelled(*names: str) -> tuple[str, ...]:
    """Names of a quantity, also after the words by which phones, cameras, drones and ROS begin them."""
    return tuple(
        start + name
        for start in ("", "location", "gps", "gnss", "position", "field", "osd")
        for name in names
    )


DEGREES = {
    **dict.fromkeys(("deg", "degree", "degrees", "°", "dd", "wgs84"), 1.0),
    **dict.fromkeys(("dege7", "1e7deg"), 1e-7),
    "rad": 180 / math.pi,
}
"""Factors to degrees of units that headings may state."""
METERS = {
    **dict.fromkeys(("m", "meter", "meters", "metre", "metres"), 1.0),
    **dict.fromkeys(("ft", "foot", "feet"), 0.3048),
    **dict.fromkeys(("msl", "amsl"), math.nan),
    "km": 1e3,
    "cm": 1e-2,
    "mm": 1e-3,
}
"""Factors to meters; above sea level is no unit."""
NOWHERE = Unknown((0.0, -1.0, 90.0, 91.0, 180.0, 181.0, -180.0, 200.0, *NINES, *LIMITS), near=0.01)
"""Of coordinates: 0 before the first fix, 91 and 181 of AIS, -180 of iOS. Degrees: 1.1 km."""
NO_HEIGHT = Unknown((0.0, -1.0, *NINES, *LIMITS, 12607.0), near=2.0)
"""Of altitudes: 0 without a fix in three dimensions, -32768 of terrain models, 12607 of FIT; -9999. Meters: at the sea
there are others that near."""
POSITION_COLUMNS = {
    **TIMES,
    "name": Column(("name", "image", "filename", "file", "sourcefile")),
    "latitude": Column(spelled("latitude", "lat"), DEGREES, NOWHERE),
    "longitude": Column(spelled("longitude", "lon", "lng", "long"), DEGREES, NOWHERE),
    "altitude": Column(spelled("altitude", "alt", "elevation", "ele"), METERS, NO_HEIGHT),
    "std_horizontal": Column(spelled("stdhorizontal", "horizontalaccuracy", "hacc"), METERS, Unknown(NINES)),
    "std_vertical": Column(spelled("stdvertical", "verticalaccuracy", "vacc"), METERS, Unknown(NINES)),
    "north": Column(spelled("ns", "latituderef", "latref", "latitudens", "latns", "latitudehemisphere")),
    "east": Column(spelled("ew", "longituderef", "lonref", "longitudeew", "lonew", "longitudehemisphere")),
}
SPEEDS = {
    **dict.fromkeys(("ms", "mps", "msec", "ms1", "meterssecond"), 1.0),
    **dict.fromkeys(("kmh", "kph", "kmph"), 1 / 3.6),
    **dict.fromkeys(("mph", "mih"), 0.44704),
    **dict.fromkeys(("kn", "kt", "kts", "knot", "knots"), 1852 / 3600),
    **dict.fromkeys(("fts", "ftsec", "fps"), 0.3048),
    "cms": 0.01,
    "mms": 0.001,
}
"""Factors to m/s."""
# Of iOS, also as other units are rounded.
_AS_MINUS_ONE = [-round(1 / factor, digits) for factor in {*SPEEDS.values()} for digits in range(1, 7)]
NO_SPEED = Unknown((*_AS_MINUS_ONE, *NINES, *LIMITS), near=0.3)
"""Of speeds: -1 m/s, and -9999. A vehicle that backs up, or drives at 99 km/h, has others around them; one that stands
errs by .1."""
SPEED = Column(spelled("speed", "velocity", "groundspeed", "speed3d", "3dspeed"), SPEEDS, NO_SPEED)
NO_SAMPLE = Unknown((*NINES, *LIMITS), near=1.0)
"""Of rates and forces, rad/s and m/s^2: fill values and the largest integers."""
