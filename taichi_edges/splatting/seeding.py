"""Where the Gaussians start."""

import numpy as np


def random_points(count, box, generator):
    """(count, 3) points uniform in the box (2, 3): the supplement's start for textureless objects."""
    box = np.asarray(box, dtype=np.float64)
    return box[0] + generator.random((count, 3)) * (box[1] - box[0])


def given_points(points, count, generator):
    """At most `count` of the (n, 3) given points, drawn without repetition where there are more."""
    if len(points) <= count:
        return points
    return points[np.sort(generator.choice(len(points), count, replace=False))]
