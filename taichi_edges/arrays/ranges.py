"""Ranges of different lengths in one array, one after the other."""

import numpy as np


def ragged(counts: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """0 .. c - 1 for each of the (m,) counts c: which of them each entry is of, (n,) int, and the entries, (n,) int."""
    of = np.repeat(np.arange(len(counts)), counts)
    return of, np.arange(len(of)) - starts_of(counts)[of]


def starts_of(counts: np.ndarray) -> np.ndarray:
    """(m,) int: where each range of (m,) counts starts, when they lie one after the other."""
    return np.cumsum(counts) - counts
