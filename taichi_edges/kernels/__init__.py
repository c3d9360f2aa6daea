"""Taichi that several rooms share: the device, points in cameras, edgels in a grid."""
