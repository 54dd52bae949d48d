"""A short fuzz run over codec and services, the corpus, and the mutations."""

import json
import random

import pytest

from gausslite.cli.main import main
from gausslite.codec.subset_codec import decode_subset
from gausslite.domain.errors import ChecksumError
from gausslite_bench.async_calls import service_methods
from gausslite_bench.fuzz.checksummed_messages import change_body, with_checksum
from gausslite_bench.fuzz.decoders import CORPUS, DECODERS, Outcomes, decode_one, read_corpus
from gausslite_bench.fuzz.mutations import Mutator
from gausslite_bench.fuzz.protobuf_fields import change_field, encode_fields, parse_fields


@pytest.mark.slow
def test_no_mutated_message_crashes_or_blocks_a_program(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["bench", "fuzz", "--messages", "1000", "--seed", "5", "--json"]) == 0
    results = json.loads(capsys.readouterr().out)["targets"]
    assert [each["target"] for each in results] == ["codec", "FusionService", "AgentService", "ParserService"]
    assert sum(each["messages"] for each in results) == 1000
    assert all(each["crashes"] == each["hangs"] == 0 for each in results)
    # valid messages and refusals both occur, so the mutations are neither too weak nor too strong
    assert all(each["results"]["OK"] < each["messages"] for each in results)


def test_the_corpus_has_valid_messages_for_every_decoder_and_every_method() -> None:
    corpus = read_corpus(CORPUS)
    methods = {f"{service.rpartition('.')[2]}.{name}" for service, names in service_methods().items() for name in names}
    assert corpus.keys() == methods | DECODERS.keys()
    outcomes = Outcomes()
    for name in DECODERS:
        for data in corpus[name]:
            decode_one(name, data, outcomes)
    assert outcomes.results.keys() == {"OK"}
    assert sum(len(data) for messages in corpus.values() for data in messages) < 300_000


def test_a_decoder_with_an_unexpected_error_is_a_crash(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("gausslite_bench.fuzz.decoders.DECODERS", {"subset": lambda data: data[10]})
    outcomes = Outcomes()
    decode_one("subset", b"short", outcomes)
    assert outcomes.crashes == [("subset: IndexError: index out of range", b"short")]


def test_a_seed_gives_the_same_messages() -> None:
    data = read_corpus(CORPUS)["subset"]
    first, second = (
        [mutator.mutate_codec(mutator.choose(data), data) for _ in range(50)] for mutator in (Mutator(1), Mutator(1))
    )
    assert first == second
    assert len(set(first)) > 40


def test_a_changed_body_passes_the_checks_of_checksum_and_size() -> None:
    message = read_corpus(CORPUS)["subset"][0]
    assert decode_subset(change_body(message, bytes))[0].update_seq == decode_subset(message)[0].update_seq
    damaged = message[:-1] + bytes([message[-1] ^ 1])
    pytest.raises(ChecksumError, decode_subset, damaged)
    assert with_checksum(damaged) == message


def test_fields_of_every_request_of_the_corpus_are_encoded_as_they_were_parsed() -> None:
    rng = random.Random(0)
    for name, messages in read_corpus(CORPUS).items():
        for data in messages if "Service." in name else ():
            fields = parse_fields(data)
            assert fields is not None
            assert encode_fields(fields) == data
            assert parse_fields(change_field(data, rng)) is not None
    assert parse_fields(b"\x0a\xff") is None
