"""What setup.cfg has no words for: the scenes, which lie beside the package, are installed into it."""

from setuptools import find_packages, setup

setup(packages=[*find_packages(include=["taichi_edges*"]), "taichi_edges.scenes"])
