"""The colours of everything that is written to be looked at. RGB, uint8."""

import numpy as np

# Vermilion and blue of Okabe and Ito's set: told apart with every common colour blindness, on white and on grey.
LINE_COLOUR = (213, 94, 0)
CURVE_COLOUR = (0, 114, 178)

# The rest of the set, for programs that show each kind of edge in a layer of its own.
KIND_COLOURS = {
    "line": LINE_COLOUR, "arc": CURVE_COLOUR, "circle": (86, 180, 233), "elliptic_arc": (0, 158, 115),
    "ellipse": (204, 121, 167), "spline": (230, 159, 0),
}  # fmt: skip

CONTOUR_COLOUR = (127, 127, 127)  # beside the kinds of edges, as contours are none
UNLABELLED_COLOUR = (150, 150, 150)  # what belongs to no cluster

# Sasha Trubetskoy's list of distinct colours, without the grey, the near-whites and black; neighbours differ most.
CLUSTER_COLOURS = np.array(
    [
        (230, 25, 75), (60, 180, 75), (0, 130, 200), (245, 130, 48), (145, 30, 180), (70, 200, 220),
        (240, 50, 230), (170, 200, 20), (0, 128, 128), (170, 110, 40), (128, 0, 0), (250, 140, 160),
        (128, 128, 0), (0, 0, 128), (255, 200, 25), (150, 120, 255),
    ],
    dtype=np.uint8,
)  # fmt: skip


def label_colours(labels: np.ndarray) -> np.ndarray:
    """(n,) int cluster labels -> (n, 3) uint8 RGB. The colours repeat after len(CLUSTER_COLOURS); -1 is grey."""
    labels = np.asarray(labels, dtype=np.int64).reshape(-1)
    colours = CLUSTER_COLOURS[labels % len(CLUSTER_COLOURS)]
    colours[labels < 0] = UNLABELLED_COLOUR
    return colours
