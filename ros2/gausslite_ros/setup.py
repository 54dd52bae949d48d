"""Install the package for colcon: launch file, parameters, entry in the ament index; the node is in the wheel."""

from setuptools import setup

NAME = "gausslite_ros"

setup(
    name=NAME,
    version="0.1.0",
    packages=[],
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (f"share/{NAME}", ["package.xml"]),
        (f"share/{NAME}/launch", ["launch/gausslite.launch.py"]),
        (f"share/{NAME}/config", ["config/gausslite.yaml"]),
    ],
    install_requires=["setuptools"],
    description="Streams a robot's camera and tf to a GaussLite agent",
    license="Apache-2.0",
    entry_points={"console_scripts": [f"gausslite_node = {NAME}.node:main"]},
)
