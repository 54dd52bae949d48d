"""Declare the options that select frames of a sequence and register its depth images."""

from __future__ import annotations

import argparse

from gausslite.config.values import (
    AUTO,
    NONE,
    read_camera_correction,
    read_camera_correction_or_auto,
    read_depth_registration,
    read_up_axis,
)
from gausslite.domain.depth_registration import DepthRegistration

_CAMERA_METAVAR = "FX,FY,CX,CY[,TX,TY,TZ[,RX,RY,RZ]]"
_REGISTER_DEPTH_HELP = (
    "shift each depth image onto the colour image (registration), for sensors with two cameras: the colour camera's "
    "intrinsics in pixels, then the depth camera's position (metres) and rotation vector (degrees) in its frame"
)
_AUTO_HELP = (
    "; none: use depth as recorded; auto: estimate the camera from image edges if the layout does not guarantee "
    "registered depth, for example 7-Scenes (default: {})"
)

_CORRECTION_METAVAR = f"{NONE}|lens=MODEL:K1,...;readout=S;offset=S"
_CORRECTION_HELP = (
    "correct images for lens distortion (radtan or fisheye with OpenCV's coefficients), for the rolling shutter's "
    "readout time, and for the offset between the times of images and poses (seconds); none: use images as recorded"
)
_CORRECTION_AUTO_HELP = (
    "; auto: the lens that the sequence's files state, and times estimated from pairs of frames (default: {})"
)


def add_frames(parser: argparse.ArgumentParser, allow_auto: bool = False, default_text: str = NONE) -> None:
    """Add --frames, --size, --up and --register-depth."""
    add = parser.add_argument_group("frames").add_argument
    add("--frames", metavar="START:STOP:STEP", default=":", help="frame numbers to use (default: all)")
    add("--size", metavar="WxH", help="resize images to this size (default: the recorded size)")
    add("--up", metavar="X,Y,Z", type=read_up_axis, help="upward direction of the world (default: the source's)")
    add_register_depth(parser, allow_auto, default_text)


def add_register_depth(parser: argparse._ActionsContainer, allow_auto: bool = False, default_text: str = NONE) -> None:
    """Add --register-depth; its value is None if the user does not set it.

    allow_auto: also accept "auto" and "none", for programs that can analyse the whole sequence first. default_text
    names in the help what the program does without the option.
    """
    parser.add_argument(
        "--register-depth",
        metavar=f"{AUTO}|{NONE}|{_CAMERA_METAVAR}" if allow_auto else _CAMERA_METAVAR,
        type=read_depth_registration if allow_auto else DepthRegistration.parse,
        help=_REGISTER_DEPTH_HELP + (_AUTO_HELP.format(default_text) if allow_auto else ""),
    )


def add_camera_correction(
    parser: argparse._ActionsContainer, allow_auto: bool = False, default_text: str = NONE
) -> None:
    """Add --camera-correction; its value is None if the user does not set it. allow_auto, default_text: as above."""
    parser.add_argument(
        "--camera-correction",
        metavar=f"{AUTO}|{_CORRECTION_METAVAR}" if allow_auto else _CORRECTION_METAVAR,
        type=read_camera_correction_or_auto if allow_auto else read_camera_correction,
        help=_CORRECTION_HELP + (_CORRECTION_AUTO_HELP.format(default_text) if allow_auto else ""),
    )
