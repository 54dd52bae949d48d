"""Scores of `bench parser` on sentences and parsers with known results."""

import itertools
import json

import pytest

from gausslite.cli.main import main
from gausslite.codec.json import graph_from_json
from gausslite.domain.errors import InvalidInputError, TaskError
from gausslite.domain.task import TaskGraph
from gausslite_bench.parser_scores import load_sentences, score_parser
from gausslite_language.rules import RuleParser

ROWS = [
    {"text": "Find a mug on a table", "targets": ["mug"], "anchors": ["table"], "relations": [["on", "mug", "table"]]},
    {"text": "Find the mug", "targets": ["mug"], "anchors": ["vase"], "relations": []},
    {"text": "Find the chair", "targets": ["table"], "anchors": [], "relations": []},
    {"text": "!", "targets": ["mug"], "anchors": [], "relations": []},
]  # fmt: skip


GRAPHS = [graph_from_json(row) for row in ROWS]


def test_scores_of_known_answers():
    clock = itertools.count()
    score = score_parser(RuleParser(), GRAPHS, lambda: float(next(clock)))
    assert (score.sentences, score.exact, score.target_set, score.anchor_set) == (4, 0.25, 0.5, 0.5)
    assert (score.median_ms, score.slowest_ms, score.by_fallback) == (1000.0, 1000.0, 0)
    assert score.wrong == tuple(row["text"] for row in ROWS[1:])


def test_answers_by_fallback_are_counted():
    class Failing:
        def parse(self, text: str) -> TaskGraph:
            if text == "!":
                raise TaskError("names nothing")
            return TaskGraph("id", text, ("mug",), (), (), ("backend http failed (late): read by rules",))

    score = score_parser(Failing(), GRAPHS)
    assert score.by_fallback == 3


def test_the_command_prints_its_figures(tmp_path, capsys):
    path = tmp_path / "sentences.json"
    path.write_text(json.dumps(ROWS))
    assert main(["bench", "parser", "--sentences", str(path), "--json"]) == 0
    printed = json.loads(capsys.readouterr().out)
    assert (printed["backend"], printed["exact"], len(printed["wrong"])) == ("rules", 0.25, 3)
    assert main(["bench", "parser", "--sentences", str(path)]) == 0
    assert "exact: 0.25\ntarget_set: 0.5\n" in capsys.readouterr().out


@pytest.mark.parametrize("text", ["", "{}", "[]", "[1]", '[{"text": "x"}]'])
def test_a_file_of_another_kind_is_refused(tmp_path, text):
    path = tmp_path / "sentences.json"
    path.write_text(text)
    pytest.raises(InvalidInputError, load_sentences, path).match("expected")
