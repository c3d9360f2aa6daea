"""Results as Markdown, ready to paste."""

import math


def table(headings, rows):
    """A Markdown table with columns of even width. Cells: text, numbers, or None for what was not measured."""
    cells = [list(headings), *([cell_text(cell) for cell in row] for row in rows)]
    widths = [max(len(row[column]) for row in cells) for column in range(len(headings))]
    lines = [
        "| " + " | ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)) + " |" for row in cells
    ]
    lines.insert(1, "|" + "|".join("-" * (width + 2) for width in widths) + "|")
    return "\n".join(lines)


def cell_text(cell):
    """'-' for None, text as it is, a number with three significant digits and no exponent."""
    if cell is None:
        return "-"
    if isinstance(cell, float):
        return significant(cell)
    return str(cell)


def significant(value, digits=3):
    """12345.6 -> '12346', 123.4 -> '123', 1.234 -> '1.23', 0.01234 -> '0.0123', NaN -> '-'."""
    if not math.isfinite(value) or value == 0.0:
        return "0" if value == 0.0 else "-"
    rounded = float(f"{value:.{digits}g}")
    return f"{value:.{max(digits - 1 - math.floor(math.log10(abs(rounded))), 0)}f}"
