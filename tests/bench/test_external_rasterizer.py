"""The driver of external rasterizers, with a small C library that records its arguments."""

from __future__ import annotations

import ctypes
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

from gausslite.mapping.splat_table import SplatTable
from gausslite_bench.raster.external_rasterizer import ExternalRasterizer
from gausslite_bench.raster.procedural_room import held_out_view, seed_rows

COMPILER = shutil.which("cc") or shutil.which("gcc") or shutil.which("clang")
if COMPILER is None:
    pytest.skip("no C compiler to build a small library with", allow_module_level=True)
pytest.importorskip("gausslite.render._kernels", reason="the native kernels are not built")

LIBRARY = r"""
#include <stdint.h>
#include <stdlib.h>
long opened, closed, threads, size[2], rows[4], modes[4], unexpected, gradients_set;
float principal_point[2], first_red, last_row_padding, first_depth;
static void *heap;
static void check(const void *p) { unexpected += (uintptr_t)p % 64 != 0; }
void *gl_new(int n) { ++opened; threads = n; heap = malloc(64); return heap; }
void gl_free(void *h) { closed += h == heap; free(h); }
void gl_setup(void *h, const float *camera, int w, int ht, const void *mask, int raw) {
  size[0] = w; size[1] = ht; principal_point[0] = camera[14]; principal_point[1] = camera[15];
  unexpected += mask != 0 || raw != 0 || h != heap;
}
void gl_forward(void *h, const float *p, int n, const void *ids) { check(p); rows[0] = n; unexpected += ids != 0; }
void gl_set_grad(void *h, const float *g) { check(g); ++gradients_set; }
void gl_backward(void *h) { ++rows[1]; }
void gl_pbwd(void *h, const float *p, float *d) { check(p); check(d); d[0] += 1.0f; ++rows[2]; }
double gl_step(void *h, float *p, int n, const void *ids, const float *rgb, const float *depth, float wc, float wd,
               float *m, float *v, const float *rates, int step, int mode) {
  check(p); check(rgb); check(depth); check(m); check(v); check(rates);
  for (int k = 0; k < 16; ++k) unexpected += rates[k] != 0.0f;
  rows[3] = n; ++modes[mode & 3];
  first_red = rgb[0]; first_depth = depth[0];
  last_row_padding = rgb[32 * 48 - 1];
  return 0.0;
}
"""


@pytest.fixture
def library(tmp_path: Path) -> Path:
    source, built = tmp_path / "recording.c", tmp_path / "librecording.so"
    source.write_text(LIBRARY)
    subprocess.run([COMPILER, "-shared", "-fPIC", "-O1", source, "-o", built], check=True)
    return built


def recorded(library: Path, name: str, length: int = 1) -> list[int]:
    return list((ctypes.c_long * length).in_dll(ctypes.CDLL(str(library)), name))


def recorded_number(library: Path, name: str) -> float:
    return ctypes.c_float.in_dll(ctypes.CDLL(str(library)), name).value


def test_the_library_gets_the_splats_the_view_and_every_operation(library: Path) -> None:
    view = held_out_view(40, 24)  # planes are padded to whole tiles: 48x32
    table = SplatTable(60)
    table.append_rows(seed_rows(60), np.zeros(60, np.bool_), np.zeros(60, np.uint32), np.zeros(60, np.int16))
    external = ExternalRasterizer(library, 3, table, view)
    with external.active():
        external.fused_l1()
        external.fused_l1_ssim()
        external.forward()
        external.backward()

    assert recorded(library, "threads") == [3]
    assert recorded(library, "size", 2) == [40, 24]
    assert recorded(library, "rows", 4) == [60, 1, 1, 60]
    assert recorded(library, "modes", 4) == [0, 1, 1, 0]
    assert recorded(library, "gradients_set") == [1]
    assert recorded(library, "opened") == recorded(library, "closed")
    assert recorded(library, "unexpected") == [0]  # aligned memory, no masks, learning rates of zero
    assert recorded_number(library, "first_red") == pytest.approx(view.rgb[0, 0, 0] / 255)
    assert recorded_number(library, "first_depth") == pytest.approx(view.depth_m[0, 0])
    assert recorded_number(library, "last_row_padding") == 0.0
    point = (ctypes.c_float * 2).in_dll(ctypes.CDLL(str(library)), "principal_point")
    assert list(point) == [view.camera.cx_px, view.camera.cy_px]
