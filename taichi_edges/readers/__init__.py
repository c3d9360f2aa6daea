"""From a folder on disk to Views. One small module for each layout, one place (`frames`) for all the checks."""

from taichi_edges.readers.emap import read_emap
from taichi_edges.readers.nerf import read_nerf

READERS = {"emap": read_emap, "nerf": read_nerf}
