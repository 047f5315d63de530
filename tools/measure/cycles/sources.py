"""Which real airframes there are: repository, licence, files, and what their makers say of their size. Pure data."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Part:
    """A mesh of an airframe, forward, left, up."""

    file: str
    colour: tuple[float, float, float] | None = None
    """Linear albedo; None: as in the file."""
    yaw_deg: float = 0.0
    position_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    mirrored: bool = False
    """Left and right."""
    scale: float = 1.0
    """Metres in the file's unit."""
    roll_deg: float = 0.0
    """Before ``yaw_deg``."""


@dataclass(frozen=True)
class Assembly:
    """Parts in one folder, and where the propellers are."""

    folder: str
    parts: tuple[Part, ...]
    hubs: tuple[tuple[float, float, float], ...]
    propeller_radius_m: float


@dataclass(frozen=True)
class Source:
    """Where an airframe comes from."""

    repository: str
    licence: str
    made_of: Assembly | str
    """Parts, or the path of an SDF model, from the meshes' folder."""
    between_motors_m: float | None = None
    """Largest distance of two motors as the maker gives it; None: no such figure was found."""


MRS = "mrs/ros_packages/mrs_uav_gazebo_simulation/models/mrs_robots_description"
"""Of a copy of ctu-mrs/mrs_uav_gazebo_simulation in ``mrs``; the other is a copy of osrf/subt in ``subt``."""
_SUBT = "subt/submitted_models"
_CARBON, _BLACK, _GREY, _RED = (0.03, 0.03, 0.03), (0.02, 0.02, 0.02), (0.2, 0.2, 0.2), (0.4, 0.02, 0.02)
_BLUE, _GREEN, _SILVER = (0.02, 0.06, 0.3), (0.05, 0.2, 0.06), (0.5, 0.5, 0.5)
_QUARTERS = (0.0, 90.0, 180.0, 270.0)
_X500_HUB, _X500_UP = 0.1812, 0.057
_M690_X, _M690_Y, _M690_UP = 0.245, 0.26, 0.052

_X500 = Assembly(
    f"{MRS}/meshes/x500v2",
    (
        Part("top_board_mesh_file.dae", None, 90.0),
        Part("bottom_board_mesh_file.dae", None, 90.0),
        *(Part("arm_carbon_mesh_file.dae", None, yaw) for yaw in _QUARTERS),
        *(Part(f"arm_plastic{k}_mesh_file.stl", _BLUE, yaw) for k in (1, 2) for yaw in _QUARTERS),
        *(
            Part(f"{name}_3d_print_mesh_file.stl", _BLACK if yaw < 180 else _RED, yaw)
            for name in ("arm", "leg")
            for yaw in _QUARTERS
        ),
        *(Part("motor_bottom_mesh_file.stl", _GREY, yaw) for yaw in _QUARTERS),
        *(Part("motor_middle_mesh_file.stl", _BLACK, yaw) for yaw in _QUARTERS),
        Part("nuc_board_mesh_file.stl", _GREEN, 90.0),
        Part("nuc_cooler_mesh_file.stl", _GREY, 90.0),
        Part("nuc_hex_posts_mesh_file.stl", _GREY, 90.0),
        Part("pixhawk6c_mesh_file.stl", _CARBON, 90.0),
        Part("battery_mount_mesh_file.stl", _RED, 90.0),
        Part("battery_mesh_file.stl", _GREY, 90.0),
        Part("gps_mount_mesh_file.stl", _GREY, 90.0),
        Part("gps_module_mesh_file.stl", _BLACK, 90.0),
    ),
    tuple((x * _X500_HUB, y * _X500_HUB, _X500_UP) for x in (1, -1) for y in (1, -1)),
    0.1651,
)
_M690 = Assembly(
    f"{MRS}/meshes/t_drones/m690b",
    (
        Part("t_drone_m690b_central_body.stl", _GREY),
        *(
            Part("t_drone_m690b_arm.stl", _CARBON, yaw, mirrored=mirrored)
            for yaw in (0.0, 180.0)
            for mirrored in (False, True)
        ),
        Part("t_drone_m690b_legs.stl", _CARBON),
        Part("t_drone_m690b_battery.stl", _SILVER),
        *(
            Part("t_drone_m690b_motor_top_part.stl", _GREY, 0.0, (x * _M690_X, y * _M690_Y, _M690_UP - 0.012))
            for x in (1, -1)
            for y in (1, -1)
        ),
    ),
    tuple((x * _M690_X, y * _M690_Y, _M690_UP) for x in (1, -1) for y in (1, -1)),
    0.229,
)
AIRFRAMES = {
    "Holybro X500 V2": Source("ctu-mrs/mrs_uav_gazebo_simulation", "BSD-3-Clause", _X500, 0.5),
    "T-Drones M690B": Source("ctu-mrs/mrs_uav_gazebo_simulation", "BSD-3-Clause", _M690, 0.69),
    "Cerberus RMF": Source("osrf/subt", "Apache-2.0", f"{_SUBT}/cerberus_rmf_sensor_config_1/model.sdf"),
    "Dynamo X4 hexacopter": Source("osrf/subt", "Apache-2.0", f"{_SUBT}/dynamo_x4_sensor_config_1/model.sdf"),
    "Emesent Hovermap carrier": Source(
        "osrf/subt", "Apache-2.0", f"{_SUBT}/emesent_hovermap_sensor_config_1/model.sdf"
    ),
    "Explorer Canary": Source("osrf/subt", "Apache-2.0", f"{_SUBT}/explorer_canary1_sensor_config_1/model.sdf"),
    "Explorer DS1": Source("osrf/subt", "Apache-2.0", f"{_SUBT}/explorer_ds1_sensor_config_1/model.sdf"),
}
