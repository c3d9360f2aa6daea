"""Binary little-endian PLY files as NumPy structured arrays, bit for bit.

Open3D is no help in three places: its point cloud reader returns a file that was cut short as though it were whole, and
its writer takes fields named `scale` for linear and clamps negative ones, where 3D Gaussian Splatting means logarithms;
and its line sets have no properties beyond colours.
"""

from collections.abc import Iterable, Sequence
from io import BufferedReader
from pathlib import Path

import numpy as np

from taichi_edges.errors import UserError, name_some
from taichi_edges.files.artefacts import replacing

NUMPY_TYPES = {
    "char": "i1", "uchar": "u1", "short": "<i2", "ushort": "<u2", "int": "<i4", "uint": "<u4", "float": "<f4",
    "double": "<f8", "int8": "i1", "uint8": "u1", "int16": "<i2", "uint16": "<u2", "int32": "<i4", "uint32": "<u4",
    "float32": "<f4", "float64": "<f8",
}  # fmt: skip

PLY_TYPES = {np.dtype(NUMPY_TYPES[name]): name for name in ("uchar", "int", "float", "double")}

LONGEST_HEADER = 1 << 16  # bytes; a foreign file is given up after so many


def write_float_vertices(path: Path | str, names: Sequence[str], columns: np.ndarray) -> Path:
    """Write a PLY whose vertices carry the float32 properties `names`. columns: (n, len(names))."""
    columns = np.ascontiguousarray(columns, dtype="<f4")
    assert columns.ndim == 2 and columns.shape[1] == len(names), columns.shape
    return write_elements(path, {"vertex": columns.view([(name, "<f4") for name in names])[:, 0]})


def write_elements(path: Path | str, elements: dict[str, np.ndarray]) -> Path:
    """Write a PLY of one element for each entry: its name, and a structured array (n,) of its properties."""
    header = "ply\nformat binary_little_endian 1.0\n"
    for element, rows in elements.items():
        header += f"element {element} {len(rows)}\n"
        assert rows.dtype.names, element
        header += "".join(f"property {PLY_TYPES[rows.dtype[name]]} {name}\n" for name in rows.dtype.names)
    with replacing(path) as unfinished, open(unfinished, "wb") as file:
        file.write((header + "end_header\n").encode("ascii"))
        for rows in elements.values():
            file.write(rows.tobytes())
    return Path(path)


def read_vertices(path: Path | str, required: Iterable[str]) -> np.ndarray:
    """Read the vertices of a PLY file, which must carry the properties named in `required`.

    Returns a structured array (n,) with one field for each property of the file.
    """
    try:
        with open(path, "rb") as file:
            count, vertex_type = _parse_header(_read_header(file))
            body = file.read(count * vertex_type.itemsize)
    except OSError as error:
        raise UserError(f"{path}: cannot be read ({error.strerror}); run the stage that writes it") from error
    except ValueError as error:
        raise UserError(f"{path}: not a PLY we can read: {error}; write it again") from error
    missing = [name for name in required if name not in (vertex_type.names or ())]
    if missing:
        raise UserError(f"{path}: its vertices lack {name_some(missing, 8)}; is it another kind of PLY?")
    if len(body) < count * vertex_type.itemsize:
        have = len(body) // vertex_type.itemsize
        raise UserError(f"{path}: cut short, {have} of {count} vertices are there; write it again")
    return np.frombuffer(body, vertex_type)


def stack_fields(vertices: np.ndarray, names: Iterable[str]) -> np.ndarray:
    """The named fields of a structured array (n,) side by side: (n, len(names)), of the first field's type."""
    return np.stack([vertices[name] for name in names], axis=1)


def _read_header(file: BufferedReader) -> list[str]:
    """The lines of the header up to `end_header`; the file is left at the first byte of the vertices."""
    lines: list[str] = []
    while file.tell() < LONGEST_HEADER:
        line = file.readline(LONGEST_HEADER).decode("ascii", "replace").strip()
        if not lines and line != "ply":
            raise ValueError("it does not begin with 'ply'")
        if line == "end_header":
            return lines
        lines.append(line)
        if not line and not file.peek(1):
            break
    raise ValueError("its header has no end")


def _parse_header(lines: list[str]) -> tuple[int, np.dtype]:
    """The number of vertices and the dtype of one vertex."""
    words = [line.split() for line in lines if line]
    if ["format", "binary_little_endian", "1.0"] not in words:
        raise ValueError("its format is not binary_little_endian 1.0")
    elements = [index for index, word in enumerate(words) if word[0] == "element"]
    vertex = words[elements[0]] if elements else []
    if len(vertex) != 3 or vertex[1] != "vertex" or not vertex[2].isdecimal():
        raise ValueError("its first element is not 'vertex' with a count")
    end = elements[1] if len(elements) > 1 else len(words)
    properties = [word for word in words[elements[0] + 1 : end] if word[0] == "property"]
    if any(len(word) != 3 or word[1] not in NUMPY_TYPES for word in properties):
        raise ValueError("a property of its vertices is not a plain number")
    return int(vertex[2]), np.dtype([(word[2], NUMPY_TYPES[word[1]]) for word in properties])
