"""From a folder on disk to Views. One small module for each layout, one place (`frames`) for all the checks."""

from taichi_edges.readers.colmap import read_colmap
from taichi_edges.readers.emap import read_emap
from taichi_edges.readers.idr import read_idr
from taichi_edges.readers.nerf import read_nerf
from taichi_edges.readers.nerfstudio import read_nerfstudio
from taichi_edges.readers.photos import read_photos

READERS = {
    "colmap": read_colmap,
    "emap": read_emap,
    "idr": read_idr,
    "images": read_photos,
    "nerf": read_nerf,
    "nerfstudio": read_nerfstudio,
}
