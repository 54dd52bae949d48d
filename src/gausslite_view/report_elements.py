"""Build HTML and SVG as a tree of elements, so that every text is escaped when the tree is written."""

from __future__ import annotations

import base64
import re
from collections.abc import Mapping
from xml.etree.ElementTree import Element, tostring

import numpy as np
from jaxtyping import UInt8
from numpy import ndarray

_JPEG_QUALITY = 88


# HTML does not allow these characters, not even escaped
_FORBIDDEN = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\ud800-\udfff\ufffe\uffff]")
_NO_ATTRIBUTES: Mapping[str, str] = {}


def element(tag: str, *children: Element | str, attributes: Mapping[str, str] = _NO_ATTRIBUTES) -> Element:
    """Return an element with its children in order. Characters that HTML forbids become U+FFFD."""
    created = Element(tag, {name: _allowed(value) for name, value in attributes.items()})
    last: Element | None = None
    for child in children:
        if isinstance(child, Element):
            created.append(child)
            last = child
        elif last is None:
            created.text = (created.text or "") + _allowed(child)
        else:
            last.tail = (last.tail or "") + _allowed(child)
    return created


def styled(tag: str, style_class: str, *children: Element | str) -> Element:
    """Return an element with a class of the style sheet."""
    return element(tag, *children, attributes={"class": style_class})


def as_html(root: Element) -> bytes:
    """Return the document as UTF-8."""
    return b"<!doctype html>\n" + tostring(root, encoding="unicode", method="html").encode() + b"\n"


def picture_url(image: UInt8[ndarray, "h w 3"]) -> str:
    """Return an RGB image as a data URI with a JPEG."""
    import cv2

    encoded = cv2.imencode(".jpg", np.ascontiguousarray(image[..., ::-1]), (cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY))[1]
    return "data:image/jpeg;base64," + base64.b64encode(encoded.tobytes()).decode()


def picture(image: UInt8[ndarray, "h w 3"], caption: str) -> Element:
    """Return an RGB image with a caption under it."""
    height, width = image.shape[:2]
    attributes = {"src": picture_url(image), "alt": caption, "width": str(width), "height": str(height)}
    return element("figure", element("img", attributes=attributes), element("figcaption", caption))


def _allowed(text: str) -> str:
    return _FORBIDDEN.sub("\ufffd", text)
