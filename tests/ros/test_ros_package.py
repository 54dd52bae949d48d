"""The colcon package is consistent: entry point, parameters file, dependencies, and ROS only in the nodes."""

import ast
import re
from pathlib import Path
from xml.etree import ElementTree

import yaml

from gausslite_ros.robot_session import NodeParameters, publications

PACKAGE = Path(__file__).resolve().parents[2] / "ros2" / "gausslite_ros"
MODULES = PACKAGE.parents[1] / "src" / "gausslite_ros"
ROS_MODULES = {"rclpy", "rosidl_runtime_py", "launch", "launch_ros", "ament_index_python"}
ROS1_MODULES = {"rospy", "genpy", "roslib", "rosgraph"}
AMENT = {"ament_index_python"}
"""Comes with launch_ros."""


def imports(path: Path) -> set[str]:
    nodes = list(ast.walk(ast.parse(path.read_text())))
    plain = {alias.name for node in nodes if isinstance(node, ast.Import) for alias in node.names}
    named = {node.module or "" for node in nodes if isinstance(node, ast.ImportFrom)}
    return {name.partition(".")[0] for name in plain | named}


def python_files() -> list[Path]:
    return [*PACKAGE.rglob("*.py"), *MODULES.glob("*.py")]


def declared() -> set[str]:
    root = ElementTree.parse(PACKAGE / "package.xml").getroot()
    return {element.text or "" for element in root.findall("exec_depend")}


def test_only_the_nodes_and_the_launch_file_import_ros() -> None:
    importing = {path.name for path in python_files() if imports(path) & ROS_MODULES}
    assert importing == {"node.py", "gausslite.launch.py"}
    assert {path.name for path in python_files() if imports(path) & ROS1_MODULES} == {"node_ros1.py"}


def test_the_manifest_declares_what_is_imported_and_published() -> None:
    used = set().union(*(imports(path) & ROS_MODULES for path in python_files())) - AMENT
    session = (MODULES / "robot_session.py").read_text()
    messages = set(re.findall(r'"(\w+)/msg/\w+"', session)) | {
        written.message_type.partition("/")[0] for written in publications(NodeParameters()).values()
    }
    assert used | messages == declared()


def test_the_parameters_file_has_the_defaults() -> None:
    content = yaml.safe_load((PACKAGE / "config" / "gausslite.yaml").read_text())
    assert content["gausslite"]["ros__parameters"] == NodeParameters.defaults()


def test_setup_installs_every_file_and_the_entry_point_exists() -> None:
    setup = (PACKAGE / "setup.py").read_text()
    for name in ("package.xml", "launch/gausslite.launch.py", "config/gausslite.yaml"):
        assert name in setup
        assert (PACKAGE / name).is_file()
    assert (PACKAGE / "resource" / "gausslite_ros").is_file()
    module = ast.parse((MODULES / "node.py").read_text())
    assert "main" in [node.name for node in module.body if isinstance(node, ast.FunctionDef)]
    version = ElementTree.parse(PACKAGE / "package.xml").getroot().findtext("version")
    assert f'version="{version}"' in setup


def test_the_page_lists_every_parameter() -> None:
    page = (PACKAGE.parents[1] / "docs" / "guides" / "bag.md").read_text()
    rows = [line.split("|")[1] for line in page.partition("| parameter |")[2].splitlines() if line.startswith("|")]
    listed = {name for row in rows for name in re.findall(r"`(\w+)`", row)}
    assert listed == set(NodeParameters.defaults())
