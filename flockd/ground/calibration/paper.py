"""The board on paper, in its true size: a page of PDF."""

from __future__ import annotations

import zlib

from flockd.ground.calibration.board import BoardSpec, CalibrationError

_PIXELS_PER_MM = 12
"""About 300 to the inch."""
_MARGIN_MM = 12.0
_POINTS_PER_MM = 72.0 / 25.4
_RULER_MM = 100.0
_LARGEST_PIXELS = 20_000
_PAGES_MM = {
    "A4": (297.0, 210.0),
    "A3": (420.0, 297.0),
    "A2": (594.0, 420.0),
    "A1": (841.0, 594.0),
    "A0": (1189.0, 841.0),
}


def board_pdf(spec: BoardSpec) -> bytes:
    """One page (ISO 32000-1): the board, what it is, and a line to check the printer with.

    Raises CalibrationError for a board that is too large to print.
    """
    pixels_per_square = round(spec.square_m * 1000.0 * _PIXELS_PER_MM)
    if not 8 <= pixels_per_square <= _LARGEST_PIXELS // max(spec.columns, spec.rows):
        raise CalibrationError(f"squares of {spec.square_m * 1000:g} mm cannot be printed; choose another size")
    image = spec.image(pixels_per_square)
    page_width, page_height = (side * _POINTS_PER_MM for side in _page(spec)[1])
    width, height = (1000.0 * spec.square_m * squares * _POINTS_PER_MM for squares in (spec.columns, spec.rows))
    left, bottom = (page_width - width) / 2, (page_height - height) / 2
    ruler, low = _RULER_MM * _POINTS_PER_MM, bottom / 2
    text = (
        f"{spec.columns}x{spec.rows} squares of {spec.square_m * 1000:g} mm, markers of {spec.marker_m * 1000:g} mm, "
        f"{spec.dictionary}. Print at 100 %; this line is {_RULER_MM:g} mm long:"
    )
    content = (
        f"q {width:.4f} 0 0 {height:.4f} {left:.4f} {bottom:.4f} cm /Board Do Q\n"
        f"BT /F 7 Tf {left:.4f} {low + 5:.4f} Td ({text}) Tj ET\n"
        f"0.5 w {left:.4f} {low:.4f} m {left + ruler:.4f} {low:.4f} l S\n"
    ).encode("ascii")
    objects = (
        b"<< /Type /Catalog /Pages 2 0 R >>",
        b"<< /Type /Pages /Kids [3 0 R] /Count 1 >>",
        f"<< /Type /Page /Parent 2 0 R /MediaBox [0 0 {page_width:.4f} {page_height:.4f}] /Contents 4 0 R /Resources "
        "<< /XObject << /Board 5 0 R >> /Font << /F << /Type /Font /Subtype /Type1 /BaseFont /Helvetica >> >> >> "
        ">>".encode("ascii"),
        _stream("", content),
        _stream(
            f"/Type /XObject /Subtype /Image /Width {image.shape[1]} /Height {image.shape[0]} "
            "/ColorSpace /DeviceGray /BitsPerComponent 8 ",
            image.tobytes(),
        ),
    )
    data, places = b"%PDF-1.4\n", []
    for number, body in enumerate(objects, start=1):
        places.append(len(data))
        data += b"%d 0 obj\n%s\nendobj\n" % (number, body)
    table = b"".join(b"%010d 00000 n \n" % place for place in places)
    head = b"xref\n0 %d\n0000000000 65535 f \n" % (len(objects) + 1)
    tail = b"trailer\n<< /Size %d /Root 1 0 R >>\nstartxref\n%d\n%%%%EOF\n" % (len(objects) + 1, len(data))
    return data + head + table + tail


def page_of(spec: BoardSpec) -> str:
    """The smallest sheet of paper that the board fits on with its margin, or the size of one made for it."""
    name, (width, height) = _page(spec)
    return name or f"{width:.0f} x {height:.0f} mm"


def _page(spec: BoardSpec) -> tuple[str, tuple[float, float]]:
    """Name and millimetres, the longer side across; no name for a size of its own."""
    width, height = (1000.0 * spec.square_m * squares for squares in (spec.columns, spec.rows))
    for name, (page_width, page_height) in _PAGES_MM.items():
        if width + 2 * _MARGIN_MM <= page_width and height + 2 * _MARGIN_MM <= page_height:
            return name, (page_width, page_height)
    return "", (width + 2 * _MARGIN_MM, height + 2 * _MARGIN_MM)


def _stream(entries: str, data: bytes) -> bytes:
    packed = zlib.compress(data, 9)
    head = f"<< {entries}/Filter /FlateDecode /Length {len(packed)} >>".encode("ascii")
    return head + b"\nstream\n" + packed + b"\nendstream"
