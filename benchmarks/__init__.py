"""Benchmarks: where the time and the memory go, as ratios measured in one run. See benchmarks/README.md."""

import os

os.environ.setdefault("ENABLE_TAICHI_HEADER_PRINT", "0")  # read when Taichi is imported: no version line on stdout
