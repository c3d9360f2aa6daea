"""Calibration of edge maps: where a detector means its edges to be, found from the inputs alone.

Learned detectors have constant biases. Their maps may be shifted by a fraction of a pixel; and where they saw images
whose alpha channel was dropped, in which an object is dilated, they put its silhouettes outside the true ones. Both are
measured in two ways: against the colour images, where there are any, and through 3D points that all views must agree
on. Of each bias the surer estimate counts, and it is corrected where it is significant.
"""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np

from taichi_edges.detectors.backgrounds import Sides, look_beside
from taichi_edges.detectors.consensus import chosen_points, displaced, observe
from taichi_edges.detectors.offsets import fit_offsets
from taichi_edges.support import line_width

LEAST_OBSERVATIONS = 200  # of a bias, against images or points; fewer tell nothing
LEAST_POINTS = 50  # 3D points that are worth asking
SURE, WORTH_PX = 3.0, 0.1  # a bias is corrected when it is so many standard errors and so many pixels
FIRST_REACH, REACH = 5.0, 3.0  # px around a 3D point within which an edgel is its: at first, and later
EDGE_LEVEL = 0.5  # of full scale, at which the width of the maps' lines is measured
FIXED, IMAGES, POINTS, NONE = "fixed", "images", "points", "none"  # methods


@dataclass(frozen=True)
class Calibration:
    """The biases of a detector's edgels, and what they leave.

    shift:        (2,) px, x to the right and y down, that the maps are shifted by; shift_error: (2,) standard errors.
    silhouette:   px that silhouettes lie outside the true ones; silhouette_error: its standard error.
    *_method:     'fixed' by the caller, measured against 'images' or 3D 'points', or 'none'.
    *_applied:    whether the edgels were corrected for it.
    residuals:    (n,) px, each corrected edgel against the 3D point that explains it, along `outward`; NaN without one.
    on_silhouette: (n,) 0..1: how surely each edgel is on a silhouette.
    outward:      (n, 2) unit vectors across the edge, on silhouettes away from the object.
    reason:       why something could not be measured; '' where all could.
    """

    shift: np.ndarray
    shift_error: np.ndarray
    shift_method: str
    shift_applied: bool
    silhouette: float
    silhouette_error: float
    silhouette_method: str
    silhouette_applied: bool
    residuals: np.ndarray
    on_silhouette: np.ndarray
    outward: np.ndarray
    reason: str


def calibrate(views, edgels, points, directions, fixed_shift=None, fixed_silhouette=None, threads=None):
    sides = sides_of(views, edgels, threads)
    known = np.full(3, np.nan)
    if fixed_silhouette is not None: known[0]=fixed_silhouette
    if fixed_shift is not None: known[1:]=fixed_shift
    ob = sides.observations(edgels.views)
    fi=None
    if ob is not None:
        for _ in range(2):
            fi=fit_offsets(ob,known); print('images',len(ob.offsets),ob.silhouette.sum(),fi.values.round(3),fi.errors.round(4),'mad',np.median(abs(fi.residuals)))
            ob=sides.observations(edgels.views,fi.values[1:])
    some=chosen_points(points); P,D=points[some],directions[some]
    start=np.zeros(3) if fi is None else fi.values
    start=np.where(np.isnan(known),start,known)
    for reach in (5,3,3):
        shift=start[1:]
        sil=sides.silhouettes(shift)
        corrected=edgels.moved(-shift-start[0]*sil[:,None]*sides.outward)
        flag=np.where(sil>=.9,1.,np.where(sides.interior,0,np.nan))
        ob=observe(views,edgels,corrected,sides.outward,flag,P,D,reach,threads)
        f=fit_offsets(ob,known,P)
        print('points',len(ob.offsets),ob.silhouette.sum(),f.values.round(3),f.errors.round(4),'mad',np.median(abs(f.residuals)),'disp',np.median(np.linalg.norm(f.displacements,axis=1)))
        P=displaced(views,P,D,np.clip(f.displacements,-3,3)); start=f.values
    return sides,f


def sides_of(views, edgels, threads=None):
    """Sides of all edgels."""
    width_px, _ = line_width(views, EDGE_LEVEL)

    def look(view):
        points, normals, _ = edgels.of_view(view)
        return look_beside(views.edge_maps[view], views.image_paths[view], points, normals, width_px)

    with ThreadPoolExecutor(threads) as pool:
        return Sides.joined(list(pool.map(look, range(len(views)))))
