"""Which real airframes cut-outs are taken of, beside those of the Cycles card; and which no network may learn from."""

from __future__ import annotations

import math

from tools.measure.cycles.sources import AIRFRAMES, MRS, Assembly, Part, Source

HELD_OUT = ("T-Drones M690B", "Cerberus RMF", "Emesent Hovermap carrier", "Explorer Canary", "DJI F450")
"""Real airframes that are rendered for tests alone."""
ROTORS = "rotors/rotors_description/meshes"
"""Of a copy of ethz-asl/rotors_simulator in ``rotors``."""

_CARBON, _BLACK, _GREY = (0.03, 0.03, 0.03), (0.02, 0.02, 0.02), (0.2, 0.2, 0.2)
_WHITE, _RED, _SILVER = (0.7, 0.7, 0.7), (0.4, 0.02, 0.02), (0.5, 0.5, 0.5)
_Place = tuple[float, float, float]


def _at(azimuth_deg: float, radius_m: float, up_m: float) -> _Place:
    """A place around the middle, forward, left, up; ``azimuth_deg`` from forward to the left."""
    angle = math.radians(azimuth_deg)
    return radius_m * math.cos(angle), radius_m * math.sin(angle), up_m


_X = (45.0, 135.0, 225.0, 315.0)
_SIX = (30.0, 90.0, 150.0, 210.0, 270.0, 330.0)
_MM = 0.001


def _ahead(azimuth_deg: float, ahead: _Place, astern: _Place) -> _Place:
    """The colour of what points there."""
    return ahead if azimuth_deg < 100.0 or azimuth_deg > 260.0 else astern


_F330 = Assembly(
    f"{MRS}/meshes",
    (
        Part("dji/f330/f330_bottom_board.dae", _GREY, -90.0),
        Part("dji/f330/f330_top_board.dae", _GREY, -90.0),
        *(Part("dji/f330/f330_arm.dae", _ahead(a, _BLACK, _RED), a + 180.0) for a in _X),
        *(
            Part("dji/f330/f330_leg_110mm.dae", _ahead(a, _BLACK, _RED), a + 180.0, position_m=_at(a, 0.165, 0.008))
            for a in _X
        ),
        *(Part("dji/f330/f330_rotor.dae", _SILVER, position_m=_at(a, 0.165, 0.017)) for a in _X),
        Part("dji/f330/f330_nuc.dae", _GREY, 270.0),
        Part("sensors/pixhawk.dae", _CARBON, position_m=(0.0, 0.0, 0.0073)),
        Part("dji/f330/f330_battery_holder.dae", _GREY, -90.0),
    ),
    tuple(_at(a, 0.165, 0.052) for a in _X),
    0.093,
)
_F450 = Assembly(
    f"{MRS}/meshes",
    (
        Part("dji/f450/dji_f450_central_bottom.dae", _GREY, position_m=(0.0, 0.0, -0.05), scale=_MM),
        Part("dji/f450/dji_f450_central_top.dae", _GREY, position_m=(0.0, 0.0, -0.012), scale=_MM),
        *(
            Part("dji/f450/dji_f450_arm.dae", _ahead(a, _WHITE, _RED), a, position_m=_at(a, 0.065, -0.012), scale=_MM)
            for a in _X
        ),
        *(
            Part("dji/f450/dji_f450_leg_170mm.dae", _ahead(a, _WHITE, _RED), a + 180.0,
                 position_m=_at(a, 0.2228, -0.11), scale=_MM)
            for a in _X
        ),
        *(Part("dji/f450/dji_f450_rotor.dae", _BLACK, position_m=_at(a, 0.23, -0.012)) for a in _X),
        Part("dji/f450/dji_f450_nuc.dae", _GREY, position_m=(0.0, 0.0, 0.023), scale=_MM),
        Part("sensors/pixhawk.dae", _CARBON, position_m=(0.0, 0.0, -0.0425)),
        Part("dji/f450/dji_f450_battery_mount.dae", _GREY, 90.0, position_m=(0.0, 0.0, -0.078), scale=_MM),
    ),
    tuple(_at(a, 0.23, 0.0115) for a in _X),
    0.118,
)  # fmt: skip
_F550 = Assembly(
    f"{MRS}/meshes",
    (
        *(Part("dji/f550/dji_f550_central_board.dae", _GREY, 30.0, position_m=(0.0, 0.0, z)) for z in (-0.05, -0.012)),
        *(
            Part("dji/f550/dji_f550_arm.dae", _ahead(a, _WHITE, _RED), a, position_m=_at(a, 0.11, -0.012), scale=_MM)
            for a in _SIX
        ),
        *(
            Part("dji/f550/dji_f550_leg_170mm.dae", _WHITE, a + 180.0, position_m=_at(a, 0.2678, -0.11), scale=_MM)
            for a in (330.0, 90.0, 210.0)
        ),
        *(Part("dji/f550/dji_f550_rotor.dae", _BLACK, position_m=_at(a, 0.275, -0.012)) for a in _SIX),
        Part("dji/f550/dji_f550_nuc.dae", _GREY, position_m=(0.0, 0.0, 0.023), scale=_MM),
        Part("sensors/pixhawk.dae", _CARBON, position_m=(0.0, 0.0, -0.0425)),
        Part("dji/f550/dji_f550_battery_and_garmin_mount.dae", _GREY, 180.0, position_m=(0.03, 0, -0.06), scale=_MM),
    ),
    tuple(_at(a, 0.275, 0.0115) for a in _SIX),
    0.118,
)
_NAKI_HUBS = tuple((x * 0.1911, y * 0.2109) for x in (1, -1) for y in (1, -1))
_NAKI = Assembly(
    f"{MRS}/meshes",
    (
        Part("custom/naki/NAKI_legless_frame.dae"),
        Part("custom/naki/NAKI_legs.dae"),
        Part("sensors/pixhawk.dae", _CARBON, position_m=(0.0, 0.0, 0.008)),
        *(
            Part("custom/naki/dji_f450_rotor.dae", _BLACK, roll_deg=roll, position_m=(x, y, z))
            for roll, z in ((0.0, -0.00925), (180.0, -0.02825))
            for x, y in _NAKI_HUBS
        ),
    ),
    tuple((x, y, z) for z in (0.01425, -0.05175) for x, y in _NAKI_HUBS),
    0.165,
)
_ROBOFLY = Assembly(
    f"{MRS}/meshes/robofly",
    (Part("body.dae", None, -90.0, roll_deg=-90.0, scale=_MM),),
    tuple(_at(a, 0.135, 0.021) for a in _X),
    0.065,
)
_PELICAN = Assembly(ROTORS, (Part("pelican.dae"),), tuple(_at(a, 0.21, 0.05) for a in (0.0, 90.0, 180.0, 270.0)), 0.128)
_OMAV = Assembly(
    f"{ROTORS}/omav",
    (Part("omav_core.dae"), *(Part("omav_tiltarm.dae", None, a, position_m=_at(a, 0.3, 0.0)) for a in _SIX)),
    tuple(_at(a, 0.3, z) for z in (0.06, -0.06) for a in _SIX),
    0.1143,
)
_MRS, _ASL = "ctu-mrs/mrs_uav_gazebo_simulation", "ethz-asl/rotors_simulator"
SOURCES = {
    **AIRFRAMES,
    "DJI F330": Source(_MRS, "BSD-3-Clause", _F330, 0.33),
    "DJI F450": Source(_MRS, "BSD-3-Clause", _F450, 0.45),
    "DJI F550": Source(_MRS, "BSD-3-Clause", _F550, 0.55),
    "NAKI": Source(_MRS, "BSD-3-Clause", _NAKI),
    "Robofly": Source(_MRS, "BSD-3-Clause", _ROBOFLY),
    "AscTec Pelican": Source(_ASL, "Apache-2.0", _PELICAN, 0.42),
    "Voliro OMAV": Source(_ASL, "Apache-2.0", _OMAV, 0.6),
    "SubT X3": Source("osrf/subt", "Apache-2.0", "subt/submitted_models/x3_sensor_config_5/model.sdf"),
}
"""All of which there are cut-outs."""
TRAINING = tuple(name for name in SOURCES if name not in HELD_OUT)
