"""Taichi outside the splatting: arrays on the device, points in cameras, and what edge maps say about points."""

import os

os.environ.setdefault("ENABLE_TAICHI_HEADER_PRINT", "0")  # read when Taichi is imported: no version line on stdout
os.environ.setdefault("TI_SKIP_VERSION_CHECK", "ON")  # nor a question to a server on the net
