"""Starts the nodes of dopslam_ros: ros2 launch dopslam_ros dopslam.launch.py --show-args."""

from pathlib import Path
from typing import Any

from launch import LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

from dopslam_ros.nodes.launching import ARGUMENTS, plan

# Beside this folder in the repository as in share/dopslam_ros.
RVIZ_FILE = Path(__file__).resolve().parents[1] / "config" / "dopslam.rviz"


def start(context: LaunchContext) -> list[Node]:
    """The nodes that the arguments ask for."""
    given = {a.name: LaunchConfiguration(a.name).perform(context) for a in ARGUMENTS}
    common: dict[str, Any] = {"namespace": given["namespace"], "output": "screen"}
    nodes = []
    for name, settings in plan(given).items():
        parameters: list[Any] = [settings] if settings else []
        if given["params_file"] and name in ("filter", "bounds"):
            parameters.append(given["params_file"])
        nodes.append(
            Node(
                package="dopslam_ros",
                executable=name,
                name=name,
                parameters=parameters,
                ros_arguments=["--log-level", given["log_level"]],
                **common,
            )
        )
    if given["rviz"] == "true":
        sim_time = {"use_sim_time": given["use_sim_time"] == "true"}
        nodes.append(
            Node(
                package="rviz2",
                executable="rviz2",
                name="rviz2",
                arguments=["-d", str(RVIZ_FILE)],
                parameters=[sim_time],
                **common,
            )
        )
    return nodes


def generate_launch_description() -> LaunchDescription:
    """What `ros2 launch` asks for."""
    declared = [
        DeclareLaunchArgument(
            a.name, default_value=a.default, description=a.text, choices=list(a.choices) or None
        )
        for a in ARGUMENTS
    ]
    return LaunchDescription([*declared, OpaqueFunction(function=start)])
