"""Check the optional extras against the metadata of the installed package."""

from __future__ import annotations

from collections.abc import Iterator
from importlib.metadata import Distribution, PackageNotFoundError, distribution, version

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from gausslite.cli.doctor.check import Check

_PROJECT = "gausslite"
_REINSTALL = "Install it with: pip install gausslite"


def extra_checks() -> Iterator[Check]:
    """Yield one check for the required packages and one for each extra."""
    try:
        installed = distribution(_PROJECT)
    except PackageNotFoundError:
        yield Check("package", "error", "gausslite runs from a source tree that is not installed", _REINSTALL)
        return
    yield _required(installed)
    for extra in sorted(installed.metadata.get_all("Provides-Extra") or ()):
        yield _extra(installed, extra)


def _required(installed: Distribution) -> Check:
    faults = [fault for each in _requirements(installed, "") if (fault := _fault(each))]
    if faults:
        return Check("package", "error", "; ".join(faults), "Repair it with: pip install --upgrade gausslite")
    return Check("package", "ok", f"gausslite {installed.version} with all required packages")


def _extra(installed: Distribution, extra: str) -> Check:
    requirements = _requirements(installed, extra)
    absent = [each.name for each in requirements if _installed_version(each) is None]
    command = f"pip install '{_PROJECT}[{extra}]'"
    name = f"extra {extra}"
    if absent:
        return Check(name, "ok", f"not installed; {', '.join(absent)} missing", f"To use it: {command}")
    faults = [fault for each in requirements if (fault := _fault(each))]
    if faults:
        return Check(name, "warning", "; ".join(faults), f"Repair it with: {command}")
    packages = sorted({f"{each.name} {_installed_version(each)}" for each in requirements})
    return Check(name, "ok", ", ".join(packages))


def _requirements(installed: Distribution, extra: str) -> list[Requirement]:
    """Return what the extra adds, extras that it contains included; for an empty name what is always required."""
    found = []
    for text in installed.requires or ():
        requirement = Requirement(text)
        is_added = requirement.marker is None or requirement.marker.evaluate({"extra": extra})
        is_always = requirement.marker is None or requirement.marker.evaluate({"extra": ""})
        if not is_added or (extra and is_always):
            continue
        if canonicalize_name(requirement.name) == _PROJECT:
            found += [each for part in sorted(requirement.extras) for each in _requirements(installed, part)]
        else:
            found.append(requirement)
    return found


def _installed_version(requirement: Requirement) -> str | None:
    try:
        return version(requirement.name)
    except PackageNotFoundError:
        return None


def _fault(requirement: Requirement) -> str | None:
    """Return why the installed package does not meet the requirement; None if it does."""
    found = _installed_version(requirement)
    if found is None:
        return f"{requirement.name} is missing"
    if not requirement.specifier.contains(found, prereleases=True):
        return f"{requirement.name}: expected {requirement.specifier}, got {found}"
    return None
