"""Every form of the SIMD layer offers the same functions, also those that this machine's compiler never sees."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

SIMD = Path(__file__).resolve().parents[3] / "native" / "src" / "simd"
FORMS = {
    "avx512": ("pack_avx512.h", "pack8_avx.h"),
    "avx2": ("pack_avx2.h", "pack8_avx.h"),
    "neon": ("pack_neon.h",),
}
PACK = r"(?:Pack16|Pack8|Mask16)"
MACROS = {
    "UNARY": "Pack16 {}(Pack16 a)",
    "LANEWISE": "Pack16 {}(Pack16 a, Pack16 b)",
    "MASKWISE": "Mask16 {}(Mask16 a, Mask16 b)",
    "COMPARISON": "Mask16 {}(Pack16 a, Pack16 b)",
}


def signatures(*headers: str) -> set[str]:
    """Functions over packs as `result name(argument types)`, with the macros that define families of them expanded."""
    text = "".join((SIMD / header).read_text() for header in headers)
    for macro, signature in MACROS.items():
        text = re.sub(
            rf"^GAUSSLITE_{macro}\((\S+), .*\)$",
            lambda m, to=signature: f"GAUSSLITE_INLINE {to.format(m[1])} {{",
            text,
            flags=re.MULTILINE,
        )
    found = re.findall(r"^GAUSSLITE_INLINE (\w+) (operator\S+?|\w+)\(([^{]*)\) \{", text, re.MULTILINE)
    found = [(result, name, _types(arguments)) for result, name, arguments in found]
    return {f"{result} {name}({types})" for result, name, types in found if re.search(PACK, f"{result} {types}")}


def _types(arguments: str) -> str:
    """Without the arguments' names: `Pack16& a, Pack16& b` is `Pack16&, Pack16&`."""
    return ", ".join(re.sub(r"\s*\w+$", "", argument.strip()) for argument in arguments.split(","))


def _own(signature: str) -> bool:
    """A helper of one form shows its registers."""
    return bool(re.search(r"__m\d+|\d+x\d+_t|Quad", signature))


@pytest.mark.parametrize("form", FORMS)
def test_a_form_offers_what_the_portable_one_does(form: str) -> None:
    came, wanted = ({s for s in signatures(*headers) if not _own(s)} for headers in (FORMS[form], ["pack_portable.h"]))
    assert "bool any(Mask16)" in wanted
    assert len(wanted) > 40
    assert came == wanted
