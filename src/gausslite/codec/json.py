"""Encode task graphs and an agent's objects as JSON, for the store, reports and `gausslite parse --json`."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

from gausslite.domain.errors import CodecError, GaussLiteError
from gausslite.domain.objects import NounReport, ObjectLandmark, ObjectReport, ObjectRole
from gausslite.domain.task import ObjectAttributes, Predicate, Relation, Superlative, TargetRole, TaskGraph
from gausslite.domain.voxels import AxisAlignedBox


def graph_as_json(graph: TaskGraph) -> dict[str, Any]:
    """Return everything but the graph's id and text as JSON values."""
    return {
        "targets": list(graph.targets),
        "roles": {target: str(role) for target, role in zip(graph.targets, graph.roles, strict=True)},
        "anchors": list(graph.anchors),
        "relations": [_relation_as_json(relation) for relation in graph.relations],
        "attributes": {attribute.name: _attributes_as_json(attribute) for attribute in graph.attributes},
        **{name: list(getattr(graph, name)) for name in ("excluded", "context", "warnings")},
    }


def graph_from_json(value: Mapping[str, Any]) -> TaskGraph:
    """Return the graph of `graph_as_json`, with "text" and "task_id" where given; only targets are required.

    A relation may also be a list of predicate, target and anchor. A target without a role is an object. Raises
    KeyError, TypeError, ValueError, AttributeError for other values.
    """
    targets, roles = _names(value["targets"]), dict(value.get("roles", {}))
    unknown = roles.keys() - set(targets)
    if unknown:
        raise ValueError(f"roles: expected targets, got {', '.join(sorted(map(str, unknown)))}")
    return TaskGraph(
        task_id=str(value.get("task_id", "")),
        text=str(value.get("text", "")),
        targets=targets,
        relations=tuple(_relation_from_json(relation) for relation in value.get("relations", ())),
        roles=tuple(TargetRole(roles.get(target, TargetRole.OBJECT)) for target in targets),
        attributes=tuple(
            _attributes_from_json(name, attributes) for name, attributes in value.get("attributes", {}).items()
        ),
        **{name: _names(value.get(name, ())) for name in ("anchors", "excluded", "context", "warnings")},
    )


def _relation_as_json(relation: Relation) -> dict[str, Any]:
    required = {"predicate": str(relation.predicate), "target": relation.target, "anchor": relation.anchor}
    optional = {"negated": relation.negated or None, "min_m": relation.min_m, "max_m": relation.max_m}
    return required | {name: value for name, value in optional.items() if value is not None}


def _relation_from_json(value: Mapping[str, Any] | list[str]) -> Relation:
    if isinstance(value, list):
        predicate, target, anchor = value
        return Relation(Predicate(predicate), target, anchor)
    unknown = value.keys() - {"predicate", "target", "anchor", "negated", "min_m", "max_m"}
    if unknown:
        raise ValueError(f"relation: expected predicate, target, anchor, negated, min_m and max_m, got {unknown}")
    min_m, max_m = (None if value.get(name) is None else float(value[name]) for name in ("min_m", "max_m"))
    nouns, negated = (str(value["target"]), str(value["anchor"])), bool(value.get("negated", False))
    return Relation(Predicate(value["predicate"]), *nouns, negated, min_m, max_m)


def _attributes_as_json(attributes: ObjectAttributes) -> dict[str, str]:
    values = {"colour": attributes.colour, "superlative": attributes.superlative}
    return {name: str(value) for name, value in values.items() if value is not None}


def _attributes_from_json(name: str, value: Mapping[str, Any]) -> ObjectAttributes:
    if not value or value.keys() - {"colour", "superlative"}:
        raise ValueError(f"attributes of {name!r}: expected colour, superlative or both, got {sorted(value)}")
    colour, superlative = value.get("colour"), value.get("superlative")
    known = None if superlative is None else Superlative(superlative)
    return ObjectAttributes(str(name), None if colour is None else str(colour), known)


def _names(values: Any) -> tuple[str, ...]:
    if not isinstance(values, list | tuple) or not all(isinstance(value, str) for value in values):
        raise TypeError(f"expected a list of names, got {type(values).__name__}")
    return tuple(values)


def encode_object_report(report: ObjectReport) -> bytes:
    """Return the report as JSON."""
    graph = report.graph
    names = {"task_id": graph.task_id, "text": graph.text}
    value = {**names, **graph_as_json(graph), "objects": [object_as_json(landmark) for landmark in report.objects]}
    return json.dumps(value, ensure_ascii=False).encode()


def decode_object_report(data: bytes) -> ObjectReport:
    """Return the report of `encode_object_report`. Raises CodecError."""
    try:
        value = json.loads(data)
        return ObjectReport(graph_from_json(value), tuple(object_from_json(landmark) for landmark in value["objects"]))
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
        "best_frame": report.best_frame,
        "confirmed_objects": report.objects,
        "rival": report.rival,
    }


def object_from_json(value: Mapping[str, Any]) -> ObjectLandmark:
    """Return the landmark of `object_as_json`. Raises CodecError."""
    try:
        x, y, z = (float(coordinate) for coordinate in value["centroid_m"])
        low, high = ([float(coordinate) for coordinate in value[name]] for name in ("min_m", "max_m"))
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
    except (KeyError, TypeError, ValueError, IndexError, OverflowError, GaussLiteError) as error:
        raise CodecError(f"object: expected the JSON of a landmark, got other values ({error})") from error
