"""A minimal writer of ONNX files (github.com/onnx/onnx: onnx.proto), and networks of a few weights."""

import struct

import numpy as np

FREE = ("batch", 3, "height", "width")
SIDES = np.array([[-1.0, 0, 1], [-2, 0, 2], [-1, 0, 1]]) / 20


def varint(number):
    number, out = number & (1 << 64) - 1, bytearray()
    while number > 127:
        out.append(number & 127 | 128)
        number >>= 7
    return bytes(out + bytearray([number]))


def field(number, value):
    """An int, a float, text or a message as a field of a Protocol Buffers message."""
    if isinstance(value, int):
        return varint(number << 3) + varint(value)
    if isinstance(value, float):
        return varint(number << 3 | 5) + struct.pack("<f", value)
    value = value.encode() if isinstance(value, str) else value
    return varint(number << 3 | 2) + varint(len(value)) + value


def fields(number, values):
    return b"".join(field(number, value) for value in values)


def node(operator, inputs, output, **attributes):
    """NodeProto; attributes are lists of integers or text."""
    described = []
    for name, value in attributes.items():
        content = field(4, value) + field(20, 3) if isinstance(value, str) else fields(8, value) + field(20, 7)
        described.append(field(1, name) + content)
    return fields(1, inputs) + field(2, output) + field(3, f"{output}_node") + field(4, operator) + fields(5, described)


def weights(name, values):
    """TensorProto of float32."""
    values = np.asarray(values, np.float32)
    return fields(1, values.shape) + field(2, 1) + field(8, name) + field(9, values.tobytes())


def described(name, shape, kind=1):
    """ValueInfoProto of a tensor; text in the shape leaves that side free."""
    sides = fields(1, [field(1 if isinstance(side, int) else 2, side) for side in shape])
    return field(1, name) + field(2, field(1, field(1, kind) + field(2, sides)))


def write_network(path, nodes, constants=(), outputs=("map",), shape=FREE, kind=1):
    """An ONNX file with the input 'image'. constants: {name: values}. Returns its path."""
    graph = fields(1, nodes) + field(2, "test") + fields(5, [weights(*item) for item in dict(constants).items()])
    graph += field(11, described("image", shape, kind))
    graph += fields(12, [described(name, ("batch", 1, "height", "width")) for name in outputs])
    path.write_bytes(field(1, 7) + field(8, field(1, "") + field(2, 11)) + field(7, graph))
    return path


def write_convolution(path, kernel, **more):
    """A network that correlates the three channels with a (3, k, k) kernel, zeros around the image."""
    kernel = np.asarray(kernel, np.float32)
    size = kernel.shape[-1]
    convolution = node("Conv", ["image", "kernel"], "map", kernel_shape=[size, size], pads=[size // 2] * 4)
    return write_network(path, [convolution], {"kernel": kernel[None]}, **more)


def grey_kernel(kernel):
    """A kernel of the mean of the channels."""
    return np.repeat(np.asarray(kernel, np.float32)[None], 3, axis=0) / 3


def identity(path, **more):
    return write_convolution(path, grey_kernel(np.pad([[1.0]], 1)), **more)


def write_sides(path):
    """A network of vertical edges that are bright on the right: logits from grey levels. Returns its path."""
    sides = node("Conv", ["image", "kernel", "bias"], "map", kernel_shape=[3, 3], pads=[1] * 4)
    return write_network(path, [sides], {"kernel": grey_kernel(SIDES)[None], "bias": np.array([-6.0], np.float32)})
