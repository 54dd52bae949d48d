"""Encode an agent's task graph and objects as JSON, for the fusion server's store and for reports."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

from gausslite.codec.task_json import graph_as_json, graph_from_json
from gausslite.domain.errors import CodecError, GaussLiteError
from gausslite.domain.noun_match import NounReport
from gausslite.domain.objects import ObjectLandmark, ObjectReport, ObjectRole
from gausslite.domain.voxels import AxisAlignedBox


def encode_object_report(report: ObjectReport) -> bytes:
    """Return the report as JSON."""
    graph = report.graph
    value = {
        "task_id": graph.task_id,
        "text": graph.text,
        **graph_as_json(graph),
        "objects": [object_as_json(each) for each in report.objects],
    }
    return json.dumps(value, ensure_ascii=False).encode()


def decode_object_report(data: bytes) -> ObjectReport:
    """Return the report of `encode_object_report`. Raises CodecError."""
    try:
        value = json.loads(data)
        return ObjectReport(graph_from_json(value), tuple(object_from_json(each) for each in value["objects"]))
    except (KeyError, TypeError, ValueError, AttributeError, RecursionError, GaussLiteError) as error:
        raise CodecError(f"object report: expected the JSON of a report, got other bytes ({error})") from error


def object_as_json(landmark: ObjectLandmark) -> dict[str, Any]:
    """Return a landmark as JSON values, as in report.json."""
    return {
        "id": landmark.object_id,
        "noun": landmark.noun,
        "role": str(landmark.role),
        "centroid_m": list(landmark.centroid_m),
        "min_m": list(landmark.extent_m.min_m),
        "max_m": list(landmark.extent_m.max_m),
        "confidence": landmark.confidence,
        "first_seen_ns": landmark.first_seen_ns,
        "last_seen_ns": landmark.last_seen_ns,
    }


def noun_as_json(report: NounReport) -> dict[str, Any]:
    """Return what was searched and detected for a noun as JSON values, as in report.json."""
    match = report.match
    return {
        "noun": match.noun,
        "classes": list(match.classes),
        "basis": str(match.basis),
        "similarity": match.similarity,
        "searched": match.is_searched,
        "detections": report.detections,
        "best_score": report.best_score,
        "confirmed_objects": report.objects,
        "rival": report.rival,
    }


def object_from_json(value: Mapping[str, Any]) -> ObjectLandmark:
    """Return the landmark of `object_as_json`. Raises CodecError."""
    try:
        x, y, z = (float(each) for each in value["centroid_m"])
        low, high = ([float(each) for each in value[name]] for name in ("min_m", "max_m"))
        return ObjectLandmark(
            object_id=str(value["id"]),
            noun=str(value["noun"]),
            role=ObjectRole(value["role"]),
            centroid_m=(x, y, z),
            extent_m=AxisAlignedBox((low[0], low[1], low[2]), (high[0], high[1], high[2])),
            confidence=float(value["confidence"]),
            first_seen_ns=int(value["first_seen_ns"]),
            last_seen_ns=int(value["last_seen_ns"]),
        )
    except (KeyError, TypeError, ValueError, IndexError, GaussLiteError) as error:
        raise CodecError(f"object: expected the JSON of a landmark, got other values ({error})") from error
