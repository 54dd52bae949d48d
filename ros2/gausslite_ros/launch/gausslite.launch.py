"""Start the node with a file of parameters: ros2 launch gausslite_ros gausslite.launch.py params:=my_robot.yaml."""

from pathlib import Path

from ament_index_python.packages import get_package_share_directory
from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node


def generate_launch_description() -> LaunchDescription:
    """Return the node with its parameters."""
    defaults = Path(get_package_share_directory("gausslite_ros")) / "config" / "gausslite.yaml"
    return LaunchDescription(
        [
            DeclareLaunchArgument("params", default_value=str(defaults), description="file of the node's parameters"),
            Node(
                package="gausslite_ros",
                executable="gausslite_node",
                name="gausslite",
                parameters=[LaunchConfiguration("params")],
                output="screen",
            ),
        ]
    )
