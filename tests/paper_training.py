"""The paper's schedule, for tests of the training: shortened, and otherwise as each test says."""

from taichi_edges.scene.presets import PRESETS
from taichi_edges.scene.scene_file import overlay
from taichi_edges.scene.settings import TrainConfig


def paper_training(**changes):
    """The TrainConfig of the preset `paper` with some keys changed; sections as dicts, of which other keys stay."""
    return TrainConfig(**overlay({"train": PRESETS["paper"]["train"]}, {"train": changes})["train"])
