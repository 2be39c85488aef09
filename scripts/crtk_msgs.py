"""Build crtk_msgs for the Python that runs this script, next to ROS 2 from wheels, for tests.

    build/ros/bin/python scripts/crtk_msgs.py

There are no wheels of collaborative-robotics/crtk_msgs, but those of ROS 2 Jazzy include ROS's own
generators. They generate the two messages that `surgicai_vision.robot` uses in C and Python, with
the type support of Fast DDS. `gcc` and `g++` compile them into one extension module, which is put
into that Python's site-packages. The result differs from crtk_msgs as built in a ROS workspace.
"""

import os
import subprocess
import sys
import sysconfig
import tempfile
from pathlib import Path

os.environ.setdefault("AMENT_PREFIX_PATH", sys.prefix)

import numpy
from rosidl_cli import entry_points
from rosidl_generator_c.cli import GenerateC
from rosidl_generator_py.cli import GeneratePython
from rosidl_typesupport_fastrtps_c.cli import GenerateFastRTPSCTypesupport
from rosidl_typesupport_introspection_c.cli import GenerateIntrospectionCTypesupport

PACKAGE = "crtk_msgs"
FIELDS = {
    "OperatingState": ("string state", "boolean is_homed", "boolean is_busy"),
    "StringStamped": ("string string",),
}
"""Message → its fields after the header (collaborative-robotics/crtk_msgs, msg/)."""
IDL = """#include "std_msgs/msg/Header.idl"
module {package} {{ module msg {{
struct {name} {{ std_msgs::msg::Header header; {fields} }};
}}; }};
"""
DISPATCH = """
#include <string.h>
#include "rosidl_runtime_c/message_type_support_struct.h"
#include "rosidl_typesupport_interface/macros.h"
typedef rosidl_message_type_support_t Support;
#define HANDLE(OF, NAME) ROSIDL_TYPESUPPORT_INTERFACE__MESSAGE_SYMBOL_NAME(OF, crtk_msgs, msg, NAME)
#define FAST rosidl_typesupport_fastrtps_c
#define FIELDS rosidl_typesupport_introspection_c
"""
DISPATCH_ONE = """
const Support * HANDLE(FAST, {name})(void);
const Support * HANDLE(FIELDS, {name})(void);
static const Support * find_{name}(const Support * own, const char * wanted)
{{
  if (!strcmp(wanted, "rosidl_typesupport_fastrtps_c")) return HANDLE(FAST, {name})();
  if (!strcmp(wanted, "rosidl_typesupport_introspection_c")) return HANDLE(FIELDS, {name})();
  return strcmp(wanted, own->typesupport_identifier) ? 0 : own;
}}
const Support * HANDLE(rosidl_typesupport_c, {name})(void)
{{
  static Support made;
  made = *HANDLE(FAST, {name})();
  made.typesupport_identifier = "rosidl_typesupport_c";
  made.data = 0;
  made.func = find_{name};
  return &made;
}}
"""
"""Returns the requested type support of a message: Fast DDS's own, or a field description."""
LIBRARIES = (
    *("std_msgs__rosidl_generator_c", "std_msgs__rosidl_generator_py"),
    *("std_msgs__rosidl_typesupport_fastrtps_c", "std_msgs__rosidl_typesupport_introspection_c"),
    *("rosidl_runtime_c", "rosidl_typesupport_fastrtps_c", "rosidl_typesupport_fastrtps_cpp"),
    *("rosidl_typesupport_introspection_c", "fastcdr", "rmw", "rcutils"),
)


def found_once(group: str, *, specs: list[str] | None = None, **_: object) -> dict[str, object]:
    """Return name → entry point; the wheels list each of their generators twice."""
    found = entry_points.importlib_metadata.entry_points(group=group)
    return {entry.name: entry for entry in found if not specs or entry.name in specs}


def generate(folder: Path) -> None:
    """Generate the messages' C and Python code in folder/crtk_msgs."""
    entry_points.get_entry_points = found_once
    (folder / "msg").mkdir()
    for name, fields in FIELDS.items():
        text = IDL.format(package=PACKAGE, name=name, fields=" ".join(f"{one};" for one in fields))
        (folder / "msg" / f"{name}.idl").write_text(text)
    files = [f"{folder}:msg/{name}.idl" for name in FIELDS]
    out = folder / PACKAGE
    out.mkdir()
    for generator in (
        GenerateC("c"),
        GeneratePython("py", typesupport_implementations=["rosidl_typesupport_c"]),
        GenerateFastRTPSCTypesupport("fastrtps_c"),
        GenerateIntrospectionCTypesupport("introspection_c"),
    ):
        generator.generate(PACKAGE, files, [str(Path(sys.prefix) / "share")], out)
    (out / "__init__.py").touch()
    own = "".join(DISPATCH_ONE.format(name=name) for name in FIELDS)
    (out / "dispatch.c").write_text(DISPATCH + own)


def compile_all(folder: Path) -> None:
    """Compile everything in folder/crtk_msgs into one extension module there."""
    out = folder / PACKAGE
    headers = Path(sys.prefix) / "include"
    include = [folder, headers, *headers.iterdir(), numpy.get_include()]
    options = [f"-I{path}" for path in (*include, sysconfig.get_paths()["include"])]
    objects = []
    for source in sorted(out.rglob("*.c*")):
        compiler = ("gcc",) if source.suffix == ".c" else ("g++", "-std=c++17")
        objects.append(f"{source}.o")
        command = [*compiler, "-fPIC", "-O1", "-w", *options, "-c", str(source), "-o", objects[-1]]
        subprocess.run(command, check=True)
    module = out / f"{PACKAGE}_s__rosidl_typesupport_c{sysconfig.get_config_var('EXT_SUFFIX')}"
    libraries = [f"-L{Path(sys.prefix) / 'lib'}", *(f"-l{name}" for name in LIBRARIES)]
    shared = ["g++", "-shared", "-Wl,--allow-shlib-undefined", "-o", str(module)]
    subprocess.run([*shared, *objects, *libraries], check=True)


def install(folder: Path) -> Path:
    """Copy what Python needs into site-packages; return the folder."""
    out = folder / PACKAGE
    there = Path(sysconfig.get_paths()["purelib"]) / PACKAGE
    for path in (*out.rglob("*.py"), *out.rglob("*.so")):
        target = there / path.relative_to(out)
        target.parent.mkdir(parents=True, exist_ok=True)
        target.write_bytes(path.read_bytes())
    return there


def main() -> None:
    """Generate, compile and install."""
    with tempfile.TemporaryDirectory() as given:
        folder = Path(given)
        generate(folder)
        compile_all(folder)
        print(f"crtk_msgs: {install(folder)}")


if __name__ == "__main__":
    main()
