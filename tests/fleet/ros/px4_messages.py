"""px4_msgs for the tests, made by ROS 2's own generators: PyPI has no such package, and who flies PX4 builds it."""

from __future__ import annotations

import os
import subprocess
import sys
import sysconfig
from pathlib import Path

import numpy as np

PACKAGE = "px4_msgs"
INTERFACE = """\
module px4_msgs {
  module msg {
    typedef float float__3[3];
    typedef float float__4[4];
    struct VehicleOdometry {
      uint64 timestamp; uint64 timestamp_sample; uint8 pose_frame; float__3 position; float__4 q;
      uint8 velocity_frame; float__3 velocity;
    };
  };
};
"""
"""Fields by PX4's msg/versioned/VehicleOdometry.msg, those that are read."""
GENERATE = """\
import sys
from rosidl_generator_c.cli import GenerateC
from rosidl_generator_py.cli import GeneratePython
from rosidl_typesupport_c.cli import GenerateCTypesupport
from rosidl_typesupport_fastrtps_c.cli import GenerateFastRTPSCTypesupport
package, interface, out = sys.argv[1:]
fast = ["rosidl_typesupport_fastrtps_c"]
for one in (GenerateC("c"), GeneratePython("py", typesupport_implementations=["rosidl_typesupport_c"]),
            GenerateCTypesupport("c", typesupport_implementations=fast), GenerateFastRTPSCTypesupport("fast")):
    one.generate(package, [interface], [], __import__("pathlib").Path(out))
"""
LIBRARIES = (
    *("rosidl_runtime_c", "rosidl_typesupport_c", "rosidl_typesupport_fastrtps_c", "rosidl_typesupport_fastrtps_cpp"),
    *("fastcdr", "rmw", "rcutils"),
)


def px4_messages(folder: Path) -> Path:
    """Builds the package into a folder, for PYTHONPATH. Needs a C++ compiler and some seconds."""
    ros, out = Path(sys.prefix), folder / PACKAGE
    (folder / "msg").mkdir(parents=True)
    (folder / "msg" / "VehicleOdometry.idl").write_text(INTERFACE, encoding="ascii")
    environment = {**os.environ, "AMENT_PREFIX_PATH": str(ros)}
    interface = f"{folder}:msg/VehicleOdometry.idl"
    subprocess.run([sys.executable, "-c", GENERATE, PACKAGE, interface, str(out)], env=environment, check=True)
    (out / "__init__.py").touch()
    headers = [ros / "include", *(ros / "include").iterdir(), folder, np.get_include(), sysconfig.get_path("include")]
    compiler = ["g++", "-w", "-fPIC", *(f"-I{header}" for header in headers)]
    objects = []
    for source in sorted([*out.rglob("*.c"), *out.rglob("*.cpp")]):
        objects.append(f"{source}.o")
        language = "c" if source.suffix == ".c" else "c++"
        subprocess.run([*compiler, "-x", language, "-c", str(source), "-o", objects[-1]], check=True)
    library = str(out / f"{PACKAGE}_s__rosidl_typesupport_c.so")
    where = [f"-L{ros}/lib", f"-Wl,-rpath,{ros}/lib", *(f"-l{name}" for name in LIBRARIES)]
    subprocess.run(["g++", "-shared", *objects, "-o", library, *where], check=True)
    return folder
