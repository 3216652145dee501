"""The ament_python package of gpvo's node."""

from setuptools import setup

setup(
    name="gpvo_ros",
    version="0.2.0",
    packages=["gpvo_ros"],
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/gpvo_ros"]),
        ("share/gpvo_ros", ["package.xml"]),
        ("share/gpvo_ros/launch", ["launch/live.launch.py"]),
        ("share/gpvo_ros/config", ["config/live.yaml"]),
    ],
    install_requires=["setuptools", "gpvo"],
    license="Apache-2.0",
    entry_points={"console_scripts": ["live = gpvo_ros.live:main"]},
)
