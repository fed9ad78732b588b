"""Metadata for pip and for colcon (ament_python); `pyproject.toml` holds settings of tools only."""

from pathlib import Path

from setuptools import find_packages, setup

NAME = "slam_backend"


def files(pattern: str) -> list[str]:
    return sorted(map(str, Path().glob(pattern)))


setup(
    name=NAME,
    version="0.1.0",
    description="SLAM back-end for ROS 2: a factor-graph smoother that runs live and replays bags",
    long_description="See README.md.",
    license="Apache-2.0",
    author="The slam_backend authors",
    maintainer="The slam_backend authors",
    maintainer_email="maintainers@slam-backend.invalid",
    python_requires=">=3.11",
    packages=find_packages(include=[NAME, f"{NAME}.*"]),
    package_data={NAME: ["py.typed", "lab/report/page.html"]},
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (f"share/{NAME}", ["package.xml"]),
        (f"share/{NAME}/launch", files("launch/*.py")),
        (f"share/{NAME}/config", files("config/*")),
        (f"lib/{NAME}", ["resource/backend"]),  # where `ros2 run` looks
    ],
    zip_safe=False,
    entry_points={"console_scripts": ["slam-backend = slam_backend.__main__:main"]},
    install_requires=[
        "gtsam>=4.3,<4.4",  # 4.2 ends the process in marginalCovariance on long chains
        "matplotlib",
        "mcap>=1.2",  # brings lz4 and zstandard
        "numpy>=1.26",
        "plotly>=6",
        "pydantic>=2",
        "pymap3d",
        "PyYAML",
        "rich>=13.8",
        "rosbags>=0.11",
        "typer>=0.29",
    ],
    extras_require={
        "ros": [  # x86-64 Linux; elsewhere source a ROS 2 Jazzy install. Without the pins pip takes a later distribution
            "ros-jazzy-common-interfaces==5.3.6",
            "ros-jazzy-rclpy==7.1.6",
            "ros-rclpy[fastrtps]==7.1.6",
        ],
        "eval": ["evo>=1.38"],
        "lidar": ["map-closures", "small_gicp"],
        "vision": ["opencv-python-headless"],
        "rerun": ["rerun-sdk"],
        "dev": ["hypothesis", "mypy", "pytest>=9", "ruff", "types-PyYAML"],
    },
)
