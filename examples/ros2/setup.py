"""Installs the node where `ros2 run` and `ros2 launch` find it."""

from setuptools import setup

NAME = "tofcorr_ros"

setup(
    name=NAME,
    version="0.1.0",
    packages=[NAME],
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (f"share/{NAME}", ["package.xml"]),
        (f"share/{NAME}/launch", ["launch/correct.launch.py", "launch/calibrate.launch.py"]),
    ],
    install_requires=["setuptools"],
    entry_points={
        "console_scripts": [
            f"depth_corrector = {NAME}.node:main",
            f"live_calibrator = {NAME}.calibrator:main",
        ]
    },
)
