"""Convert between task graphs and their messages; values from outside are checked here."""

from __future__ import annotations

from gausslite.domain.errors import TaskError
from gausslite.domain.task import ObjectAttributes, Predicate, Relation, Superlative, TargetRole, TaskGraph
from gausslite.domain.task_limits import require_graph
from gausslite.v1 import task_pb2

_PREDICATE_NUMBERS = {each: task_pb2.Predicate.Value(f"PREDICATE_{each.name}") for each in Predicate}
_PREDICATE_BY_NUMBER = {number: predicate for predicate, number in _PREDICATE_NUMBERS.items()}
_ROLE_NUMBERS = {each: task_pb2.TargetRole.Value(f"TARGET_ROLE_{each.name}") for each in TargetRole}
_ROLE_BY_NUMBER = {
    task_pb2.TARGET_ROLE_UNSPECIFIED: TargetRole.OBJECT,
    **{number: role for role, number in _ROLE_NUMBERS.items()},
}
_SUPERLATIVE_NUMBERS = {each: task_pb2.Superlative.Value(f"SUPERLATIVE_{each.name}") for each in Superlative}
_SUPERLATIVE_BY_NUMBER = {
    task_pb2.SUPERLATIVE_UNSPECIFIED: None,
    **{number: superlative for superlative, number in _SUPERLATIVE_NUMBERS.items()},
}


def graph_to_message(graph: TaskGraph) -> task_pb2.TaskGraph:
    """Encode a task graph."""
    return task_pb2.TaskGraph(
        task_id=graph.task_id,
        text=graph.text,
        targets=graph.targets,
        anchors=graph.anchors,
        relations=[
            task_pb2.Relation(
                predicate=_PREDICATE_NUMBERS[each.predicate],
                target=each.target,
                anchor=each.anchor,
                negated=each.negated,
                min_m=each.min_m,
                max_m=each.max_m,
            )
            for each in graph.relations
        ],
        warnings=graph.warnings,
        roles=[_ROLE_NUMBERS[role] for role in graph.roles],
        attributes=[
            task_pb2.ObjectAttributes(
                name=each.name,
                colour=each.colour or "",
                superlative=task_pb2.SUPERLATIVE_UNSPECIFIED
                if each.superlative is None
                else _SUPERLATIVE_NUMBERS[each.superlative],
            )
            for each in graph.attributes
        ],
        excluded=graph.excluded,
        context=graph.context,
    )


def graph_from_message(message: task_pb2.TaskGraph) -> TaskGraph:
    """Decode a task graph and check it with `domain.task_limits`. Raises TaskError."""
    _require_known_numbers(message)
    graph = TaskGraph(
        task_id=message.task_id,
        text=message.text,
        targets=tuple(message.targets),
        anchors=tuple(message.anchors),
        relations=tuple(_relation_from_message(each) for each in message.relations),
        warnings=tuple(message.warnings),
        roles=tuple(_ROLE_BY_NUMBER[role] for role in message.roles),
        attributes=tuple(
            ObjectAttributes(each.name, each.colour or None, _SUPERLATIVE_BY_NUMBER[each.superlative])
            for each in message.attributes
        ),
        excluded=tuple(message.excluded),
        context=tuple(message.context),
    )
    require_graph(graph)
    return graph


def _require_known_numbers(message: task_pb2.TaskGraph) -> None:
    for relation in message.relations:
        if relation.predicate not in _PREDICATE_BY_NUMBER:
            raise TaskError(
                f"task relation: expected one of {', '.join(Predicate)}, got predicate {relation.predicate}"
            )
    for role in message.roles:
        if role not in _ROLE_BY_NUMBER:
            raise TaskError(f"task roles: expected one of {', '.join(TargetRole)}, got role {role}")
    for each in message.attributes:
        if each.superlative not in _SUPERLATIVE_BY_NUMBER:
            raise TaskError(
                f"task attributes: expected one of {', '.join(Superlative)}, got superlative {each.superlative}"
            )


def _relation_from_message(message: task_pb2.Relation) -> Relation:
    return Relation(
        _PREDICATE_BY_NUMBER[message.predicate],
        message.target,
        message.anchor,
        message.negated,
        message.min_m if message.HasField("min_m") else None,
        message.max_m if message.HasField("max_m") else None,
    )
