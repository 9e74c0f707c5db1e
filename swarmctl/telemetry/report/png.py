"""Draws SVG documents as PNG. Needs the extra `swarmctl[png]`, and fonts of the system for their texts."""

from __future__ import annotations

from swarmctl.errors import StartError

_ZOOM = 2.0  # figures are 640 pixels wide


def png_of(document: str) -> bytes:
    """Return a document as PNG.

    Raises:
        StartError: the library is not installed.
    """
    try:
        from resvg_py import svg_to_bytes
    except ImportError as error:
        raise StartError("PNG needs a library of its own. Install it, in the checkout: pip install '.[png]'") from error
    return svg_to_bytes(svg_string=document, zoom=_ZOOM)
