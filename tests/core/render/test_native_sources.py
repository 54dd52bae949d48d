"""All variants of the SIMD layer have the same functions, including those not compiled on this machine."""

import re
from pathlib import Path

import pytest

SIMD = Path(__file__).resolve().parents[3] / "native" / "src" / "simd"
VARIANTS = {
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
    """Return the functions over packs as `result name(argument types)`, with macros expanded."""
    text = "".join((SIMD / header).read_text() for header in headers)
    for macro, signature in MACROS.items():
        text = re.sub(
            rf"^GAUSSLITE_{macro}\((\S+), .*\)$",
            lambda m, to=signature: f"GAUSSLITE_INLINE {to.format(m[1])} {{",
            text,
            flags=re.MULTILINE,
        )
    matches = re.findall(r"^GAUSSLITE_INLINE (\w+) (operator\S+?|\w+)\(([^{]*)\) \{", text, re.MULTILINE)
    matches = [(result, name, _types(arguments)) for result, name, arguments in matches]
    return {f"{result} {name}({types})" for result, name, types in matches if re.search(PACK, f"{result} {types}")}


def _types(arguments: str) -> str:
    """Remove the argument names: `Pack16& a, Pack16& b` becomes `Pack16&, Pack16&`."""
    return ", ".join(re.sub(r"\s*\w+$", "", argument.strip()) for argument in arguments.split(","))


def _is_internal(signature: str) -> bool:
    """Return True for helpers of one variant, whose types are registers."""
    return bool(re.search(r"__m\d+|\d+x\d+_t|Quad", signature))


@pytest.mark.parametrize("variant", VARIANTS)
def test_variant_has_the_functions_of_the_portable_one(variant: str) -> None:
    functions, expected = (
        {s for s in signatures(*headers) if not _is_internal(s)} for headers in (VARIANTS[variant], ["pack_portable.h"])
    )
    assert "bool any(Mask16)" in expected
    assert len(expected) > 40
    assert functions == expected
