"""Build description of dopslam_ros, for colcon and for pip alike.

The version bounds of the Python dependencies are here and nowhere else; package.xml names the same
dependencies by their rosdep keys. The lower bounds are what Ubuntu 24.04 (ROS 2 Jazzy) ships.
"""

from pathlib import Path

from setuptools import find_packages, setup

NAME = "dopslam_ros"
ROOT = Path(__file__).resolve().parent
NODES = ("simulator", "filter", "bounds", "recorder", "player")


def installed_tree(folder: str) -> list[tuple[str, list[str]]]:
    """List the files below `folder` as data_files entries under share/dopslam_ros."""
    files = sorted(p.relative_to(ROOT) for p in (ROOT / folder).rglob("*") if p.is_file())
    folders = sorted({path.parent for path in files})
    return [
        (f"share/{NAME}/{parent}", [str(path) for path in files if path.parent == parent])
        for parent in folders
    ]


setup(
    name=NAME,
    version="0.1.0",
    description="SLAM with radio channel measurements: delay, angles and Doppler, in ROS 2.",
    maintainer="dopslam maintainers",
    maintainer_email="dopslam@users.noreply.github.com",
    license="Apache-2.0",
    python_requires=">=3.11,<3.13",
    packages=find_packages(include=[NAME, f"{NAME}.*"]),
    package_data={
        NAME: [
            "py.typed",
            "simulation/scenes/*.yaml",
            "lab/published/*.json",
            "lab/report/assets/*",
        ],
    },
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (f"share/{NAME}", ["package.xml"]),
        *installed_tree("config"),
        *installed_tree("launch"),
        *installed_tree("bags"),
    ],
    install_requires=[
        "numpy>=1.26,<3",
        "scipy>=1.11,<2",
        "numba>=0.58,<1",
        "PyYAML>=6.0,<7",
        "matplotlib>=3.6,<4",
        "plotly>=5.15,<8",
        "rich>=13.7,<16",
        "argcomplete>=3.1,<4",
        "rosbags>=0.11.9,<0.12",
        "mcap>=1.5,<2",
        "zstandard>=0.22,<1",
    ],
    extras_require={
        # For `dopslam study` on a cluster; threadpoolctl also keeps local studies to one thread.
        "cluster": ["distributed>=2024.1,<2027", "threadpoolctl>=3.1,<4"],
        # colcon test looks for pytest here; without it, it runs no test and reports success.
        "test": [
            "furo>=2024.1,<2027",
            "pytest>=7.4,<10",
            "pytest-timeout>=2.2,<3",
            "pytest-rerunfailures>=13,<17",
            "pytest-xdist>=3.4,<4",
            "stonesoup>=1.4,<2",
            "mypy>=1.10,<3",
            "ruff>=0.6,<1",
            "sphinx>=7.2,<10",
            "selenium>=4.15,<5",
            "types-PyYAML>=6.0,<7",
            "distributed>=2024.1,<2027",
            "threadpoolctl>=3.1,<4",
        ],
    },
    zip_safe=False,
    entry_points={
        "console_scripts": [
            *(f"{node} = {NAME}.nodes.{node}:main" for node in NODES),
            f"dopslam = {NAME}.cli.main:main",
        ],
    },
)
