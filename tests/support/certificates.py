"""Certificates for tests, made by the script in deploy."""

import shutil
import subprocess
from pathlib import Path

import pytest

from gausslite.wire.security import Tls

SCRIPT = Path(__file__).resolve().parents[2] / "deploy" / "make_certificates.sh"


def make_certificates(folder: Path, *names: str) -> Path:
    """Make a folder with an authority and a certificate for each name."""
    if shutil.which("openssl") is None:
        pytest.skip("certificates need the program openssl")
    subprocess.run(["bash", str(SCRIPT), str(folder), *names], check=True, timeout=60)
    return folder


def identity(folder: Path, name: str) -> Tls:
    """Return the identity of this name, which trusts the folder's authority."""
    return Tls.read(folder / name / "cert.pem", folder / name / "key.pem", folder / name / "ca.pem")
