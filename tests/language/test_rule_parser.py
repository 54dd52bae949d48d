"""The rule parser on hand-written sentences, and on text that is not a task."""

import time
from pathlib import Path

import pytest

from gausslite.codec.json import graph_as_json
from gausslite.domain.errors import TaskError
from gausslite.domain.task import Predicate, Relation, TargetRole, TaskGraph, require_graph
from gausslite_bench.parser_scores import load_sentences, matching_parts, score_parser
from gausslite_language import lexicon
from gausslite_language.grounding import task_id_of
from gausslite_language.lexicon import COLOURS, COMMON_ANCHORS, singular
from gausslite_language.rules import RuleParser

SENTENCES = load_sentences()
PAPER_SENTENCES = 6
DAILY_TASKS = Path(__file__).with_name("daily_tasks.json")
FIRST_SIGHT = Path(__file__).with_name("first_sight")


@pytest.mark.parametrize("expected", SENTENCES[:PAPER_SENTENCES], ids=lambda graph: graph.text)
def test_the_papers_tasks(expected):
    assert RuleParser().parse(expected.text).is_equivalent_to(expected)


def test_graphs_of_ordinary_sentences_are_exact():
    score = score_parser(RuleParser(), SENTENCES)
    print(f"exact graphs: {score.exact:.1%} of {score.sentences}; wrong: {score.wrong}")
    assert score.sentences >= 600
    assert score.exact >= 0.95, score.wrong
    assert score.opposites == ()


@pytest.mark.parametrize("path", sorted(FIRST_SIGHT.glob("*.json")), ids=lambda path: path.stem)
def test_no_sentence_of_a_foreign_set_is_read_as_its_opposite(path):
    score = score_parser(RuleParser(), load_sentences(path))
    print(f"exact graphs: {score.exact:.1%} of {score.sentences}; wrong: {score.wrong}")
    assert score.opposites == ()
    assert score.exact >= 0.6


@pytest.mark.parametrize(
    ("text", "denied"),
    [
        ("Set the cup beside the sink, not in the tub", "tub"),
        ("Hand me the cup, no, the glass", "cup"),
        ("Clean the mirror but not with the sponge", "sponge"),
        ("Move all the chairs but the broken one to the garage", "broken chair"),
        ("Do not put the knife in the dishwasher, wash it in the sink", "dishwasher"),
        ("Sweep the hall but stay off the yellow line", "line"),
        ("Pick the ripe plums and leave the green ones on the tree", "plum"),
        ("Bring me neither the fork nor the knife but the spoon", "fork"),
        ("Do not put the vase on the table but on the shelf", "table"),
        ("Bring the plate, no wait, bring the bowl", "plate"),
        ("Take the box to the kitchen. No, to the garage", "kitchen"),
        ("Drive to the gate, staying clear of the cranes", "crane"),
        ("Pull the cart to the gate, avoiding people", "person"),
        ("Give the dog a wide berth and go to the chair", "dog"),
        ("Collect everything save for the spade", "spade"),
        ("Bring a spoon, any but the wooden one", "wooden spoon"),
        ("Dust the shelf. Hands off the globe", "globe"),
        ("Dust the shelf; the globe stays where it is", "globe"),
        ("There's no need to mop the hall floor; mop the stairs", "hall floor"),
        ("Refrain from opening the cabinet; open the drawer", "cabinet"),
        ("Under no circumstances touch the oven while you wipe the sink", "oven"),
        ("Cancel the tea pot. Take the jug", "tea pot"),
        ("Bring the jug. No, wait, the bowl", "jug"),
        ("Bring a jug. Actually, make that a bowl", "jug"),
        ("Bring another jug than the glass jug", "glass jug"),
        ("Stay out of the pantry, and sweep the hall", "pantry"),
        ("Go to the printer, actually make that the scanner", "printer"),
        ("Grab the bucket, oh no, I meant the basket", "bucket"),
        ("Grab the lemon, hmm no, the lime, from the bowl", "lemon"),
        ("Get me the drill. On second thought, get me the rasp", "drill"),
        ("Stop at the kiosk, disregard, stop at the booth", "kiosk"),
        ("Bring the big hammer, not that one, the small hammer", "big hammer"),
        ("Follow the man. Not that man, the woman", "man"),
        ("Put the jacket not on the chair, on the hanger", "chair"),
        ("Carry the boxes anywhere but the van", "van"),
        ("Nothing on the altar may be moved, but dust the bench", "object"),
        ("Neither the lamp nor the rug may be touched while you dust the shelf", "lamp"),
        ("Drive to the ramp, cones are to be avoided", "cone"),
        ("Tidy the desk and don't you dare touch the laptop", "laptop"),
        ("Clean the window but the curtain you don't touch", "curtain"),
        ("Count all animals, goats excepted", "goat"),
        ("The mirror can wait, clean the sink", "mirror"),
        ("I'd rather have the pear than the apple", "apple"),
        ("You needn't clean the mirror, clean the sink", "mirror"),
        ("Leave the jug, take the cup", "jug"),
        ("Mop the stairs and avoid mopping the ramp", "ramp"),
        ("Stop stacking crates near the exit and stack them by the wall", "exit"),
        ("You should avoid driving on the lawn, go to the shed", "lawn"),
        ("Go to the gate avoiding people", "person"),
        ("Hold off on opening the crate and open the drawer", "crate"),
        ("Make sure to avoid touching anything on the shelf while you dust the lamp", "object"),
    ],
)
def test_what_is_denied_is_not_handled(text, denied):
    graph = RuleParser().parse(text)
    handled = {name for name, role in zip(graph.targets, graph.roles, strict=True) if role is not TargetRole.OBSTACLE}
    assert denied not in handled
    assert denied in (*graph.excluded, *graph.targets)


@pytest.mark.parametrize(
    ("text", "denied"),
    [
        ("Pick up the jug that isn't near the sink or on the bench", {"sink", "bench"}),
        ("Find a bench lacking a cushion", {"cushion"}),
        ("Find the bench that is free of tools", {"tool"}),
        ("The jug is no longer on the bench. Find it", {"bench"}),
        ("Water the plants, though not the ones on the bench", {"bench"}),
        ("Look everywhere but in the locker for my boots", {"locker"}),
    ],
)
def test_a_place_that_is_denied_is_negated(text, denied):
    relations = RuleParser().parse(text).relations
    assert {relation.anchor for relation in relations} == denied
    assert all(relation.negated for relation in relations)


@pytest.mark.parametrize(
    ("text", "target", "colour"),
    [
        ("Bring the jugs, but only the clean ones", "clean jug", None),
        ("Bring the jugs from the bench, only the red ones", "jug", "red"),
        ("Bring the jug, not the green one, the red one", "jug", "red"),
    ],
)
def test_ones_that_narrow_an_object_replace_it(text, target, colour):
    graph = RuleParser().parse(text)
    assert graph.targets == (target,)
    assert [attribute.colour for attribute in graph.attributes] == ([colour] if colour else [])


def test_colours_joined_by_or_are_all_denied():
    graph = RuleParser().parse("Pick up any jug that isn't blue or green")
    assert graph.targets == ("jug",)
    assert {attribute.colour for attribute in graph.attributes if attribute.name in graph.excluded} == {"blue", "green"}


@pytest.mark.parametrize(
    "text", ["Bring die rote Tasse bitte", "Apporte-moi la tasse rouge", "Porta la tazza in cucina"]
)
def test_a_sentence_in_another_language_is_refused(text):
    pytest.raises(TaskError, RuleParser().parse, text)


@pytest.mark.parametrize("expected", load_sentences(DAILY_TASKS), ids=lambda graph: graph.text)
def test_daily_tasks(expected):
    parsed = RuleParser().parse(expected.text)
    assert all(matching_parts(expected, parsed)), graph_as_json(parsed)
    assert set(parsed.context) >= set(expected.context)


FRAMES = [
    "Clean the {}", "Find the {} on the shelf", "Bring me the red {} and the glorb", "Where is the {}?",
    "Is the {} under the shelf broken?", "Put the {} next to the shelf",
]  # fmt: skip


@pytest.mark.parametrize("at", range(len(FRAMES)))
def test_every_known_noun_is_parsed_as_a_noun(at):
    no_objects = lexicon.PLACES | lexicon.MEASURES | lexicon.ADDRESSEES | lexicon.ROUTES | lexicon.TASK_NOUNS
    parser, adjective = RuleParser(), "red " if "red" in FRAMES[at] else ""
    for noun in sorted(lexicon.NOUNS - no_objects - lexicon.ADJECTIVES - COLOURS)[at :: len(FRAMES)]:
        graph = parser.parse(FRAMES[at].format(noun))
        assert singular(noun) in (*graph.targets, *graph.context)
        assert not adjective or any(each.colour == "red" for each in graph.attributes)


@pytest.mark.slow
def test_a_sentence_takes_less_than_10_ms():
    parser = RuleParser()
    parser.parse("warm up the table")
    durations = []
    for each in SENTENCES:
        started = time.thread_time()  # excludes time of other processes
        parser.parse(each.text)
        durations.append(time.thread_time() - started)
    assert sorted(durations)[len(durations) // 2] < 0.010


@pytest.mark.parametrize(
    ("text", "excluded"),
    [
        ("Ignore people and map the chairs", "person"), ("Map the chairs except the stool", "stool"),
        ("Clean the desk but skip the laptop", "laptop"), ("Harvest the tomatoes but leave the cucumbers", "cucumber"),
    ],
)  # fmt: skip
def test_excluded_objects_are_no_targets(text, excluded):
    graph = RuleParser().parse(text)
    assert excluded not in (*graph.targets, *graph.anchors)
    assert graph.excluded == (excluded,)


@pytest.mark.parametrize(
    ("text", "obstacle"),
    [
        ("Pick up the mug without touching the vase", "vase"),
        ("Go to the door without bumping into the table", "table"),
        ("Don't touch the lamp, pick up the book", "lamp"), ("Clean the desk but leave the laptop alone", "laptop"),
        ("Be careful not to break the bowl and pick up the spoon", "bowl"), ("Do not touch the vase", "vase"),
        ("Keep the boy from touching the vase and take a jug", "vase"), ("Take the jug but avoid the robot", "robot"),
    ],
)  # fmt: skip
def test_objects_not_to_be_touched_are_obstacles(text, obstacle):
    graph = RuleParser().parse(text)
    assert graph.roles[graph.targets.index(obstacle)] is TargetRole.OBSTACLE
    assert graph.excluded == ()


@pytest.mark.parametrize(
    ("text", "targets", "anchors"),
    [
        ("Pick this up", ("object",), ()), ("Put that on the tray", ("object", "tray"), ()),
        ("Leave it on the porch", ("object", "porch"), ()), ("Clean them", ("object",), ()),
    ],
)  # fmt: skip
def test_a_demonstrative_means_any_object_with_a_warning(text, targets, anchors):
    graph = RuleParser().parse(text)
    assert (graph.targets, graph.anchors) == (targets, anchors)
    assert "refers to no named object" in graph.warnings[0]


@pytest.mark.parametrize(
    ("text", "relations"),
    [
        ("Go to the desk and take the mug on it", (Relation(Predicate.ON, "mug", "desk"),)),
        ("Clean the table and everything on it", (Relation(Predicate.ON, "object", "table"),)),
        ("Find the vase and put it on the shelf", ()),
        ("Take the vase on the desk and wipe it", (Relation(Predicate.ON, "vase", "desk"),)),
    ],
)
def test_pronouns_refer_to_named_objects(text, relations):
    graph = RuleParser().parse(text)
    assert graph.relations == relations
    assert graph.warnings == ()


@pytest.mark.parametrize(
    ("text", "role"),
    [
        ("Carry the crate to my spot behind the truck", "destination"),
        ("Carry the crate to the area with the truck", "destination"),
        ("Carry the crate to the left of the truck", "destination"),
        ("Take the crate to the left side of the truck", "destination"),
        ("Carry the crate that is to the left of the truck", None),
        ("Can I have the crates stacked near the truck", "destination"),
        ("Do you have any crates stacked near the truck", None),
        ("Get the crates loaded onto the truck", "destination"),
        ("Get the crates stacked near the truck", None),
    ],
)
def test_where_a_moved_thing_ends_is_a_destination(text, role):
    graph = RuleParser().parse(text)
    assert dict(zip(graph.targets, graph.roles, strict=True)).get("truck") == role
    assert bool(graph.relations) == (role is None)


@pytest.mark.parametrize("predicate", sorted(set(Predicate) - {Predicate.BETWEEN}))
def test_every_predicate_has_a_preposition(predicate):
    graph = RuleParser().parse(f"Find the mug {predicate.replace('_', ' ')} the table")
    assert graph.relations == (Relation(predicate, "mug", "table"),)


def test_an_unknown_relation_becomes_near_with_a_warning():
    graph = RuleParser().parse("Find the shoe opposite the couch")
    assert graph.relations == (Relation(Predicate.NEAR, "shoe", "couch"),)
    assert graph.warnings == ("'opposite' 'couch' is not a known relation: treated as near",)


@pytest.mark.parametrize(
    ("text", "relation"),
    [
        ("Find the chair far from the door", Relation(Predicate.NEAR, "chair", "door", negated=True)),
        ("Find the cup that is not on the table", Relation(Predicate.ON, "cup", "table", negated=True)),
        ("Find the cup that isn't on the table", Relation(Predicate.ON, "cup", "table", negated=True)),
        ("Find the cup not to the left of the table", Relation(Predicate.LEFT_OF, "cup", "table", negated=True)),
        ("Find the box outside the crate", Relation(Predicate.INSIDE, "box", "crate", negated=True)),
        ("Find the worker without a helmet", Relation(Predicate.NEAR, "worker", "helmet", negated=True)),
        ("Find the worker who isn't wearing a helmet", Relation(Predicate.NEAR, "worker", "helmet", negated=True)),
    ],
)
def test_a_negated_relation_is_never_read_as_its_opposite(text, relation):
    assert RuleParser().parse(text).relations == (relation,)


@pytest.mark.parametrize(
    "text",
    [
        "Take the keys and don't forget the umbrella",
        "Don't forget to take the keys and the umbrella",
        "Don't stop carrying the keys and the umbrella",
    ],
)
def test_a_double_negation_is_a_request(text):
    graph = RuleParser().parse(text)
    assert (graph.targets, graph.excluded) == (("key", "umbrella"), ())


@pytest.mark.parametrize(
    ("text", "obstacles"),
    [
        ("Place the candle at least 1 m away from the curtain", ["curtain"]),
        ("Put the laptop on the desk, no closer than 30 cm to the radiator", ["radiator"]),
        ("Move the sofa at least one metre away from the fireplace", ["fireplace"]),
        ("Set the knife out of reach of the children", ["child"]),
        ("Keep the dog away from the cake and the pie", ["cake", "pie"]),
        ("Carry the tray to the table at a safe distance from the piano", ["piano"]),
        ("Never put the bottle closer than half a metre to the fire", ["fire"]),
        ("Drive past the shelf, keeping at least 30 cm from the boxes", ["box"]),
        ("Push the cart away from the door", []),
        ("Put the lamp on a table far from the window", []),
        ("Park within a metre of the charger", []),
    ],
)
def test_what_a_thing_is_kept_away_from_is_an_obstacle(text, obstacles):
    graph = RuleParser().parse(text)
    roles = dict(zip(graph.targets, graph.roles, strict=True))
    assert [name for name, role in roles.items() if role is TargetRole.OBSTACLE] == obstacles


@pytest.mark.parametrize(
    ("phrase", "predicate", "min_m", "max_m"),
    [
        ("1.5 m from", Predicate.NEAR, 1.5, 1.5), ("no further than a metre from", Predicate.NEAR, None, 1.0),
        ("within 2m of", Predicate.NEAR, None, 2.0), ("at least two feet away from", Predicate.NEAR, 0.61, None),
        ("no closer than 30 cm to", Predicate.NEAR, 0.3, None),
        ("between 1 and 2 metres from", Predicate.NEAR, 1.0, 2.0), ("half a metre behind", Predicate.BEHIND, 0.5, 0.5),
        ("less than 3 steps to the left of", Predicate.LEFT_OF, None, 2.25),
    ],
)  # fmt: skip
def test_distances_bound_a_relation(phrase, predicate, min_m, max_m):
    graph = RuleParser().parse(f"Find the mug {phrase} the door")
    assert graph.relations == (Relation(predicate, "mug", "door", False, min_m, max_m),)


@pytest.mark.parametrize(
    ("text", "word"),
    [
        ("Open the second drawer", "second"),
        ("Open the 2nd drawer", "2nd"),
        ("Take the most worn chair", "most"),
        ("Take the oldest box", "oldest"),
        ("Find the mug a few metres from the door", "door"),
        ("Find the mug within -3 metres of the door", "door"),
        ("Find the mug at most -0.5 m from the door", "door"),
        ("Find the mug within minus two metres of the door", "door"),
        ("Pick up all mugs except the red one near the sink", "sink"),
    ],
)
def test_what_is_not_understood_is_a_warning(text, word):
    graph = RuleParser().parse(text)
    assert any(word in warning for warning in graph.warnings)
    assert all(word not in name for name in (*graph.queries, *graph.excluded))


@pytest.mark.parametrize(
    ("text", "same", "warning"),
    [
        ("grab teh mgu frm the tabel", "Grab the mug from the table", "'mgu' is read as 'mug'"),
        ("pls find teh vaze b4 the windw", "Find the vase before the window", "'vaze' is read as 'vase'"),
        ("clean dsk w/ the spnge", "Clean desk with the sponge", "'dsk' is read as 'desk'"),
        ("whres the mug", "where is the mug", "'whres' is read as 'where is'"),
        ("load an aple onto the truk", "Load an apple onto the truck", "'truk' is read as 'truck'"),
        ("Meet Jahne at the door", "Meet Jahne at the door", "'jahne' is no known noun: it may be misread"),
    ],
)
def test_what_is_typed_in_a_hurry_is_read_with_a_warning(text, same, warning):
    graph = RuleParser().parse(text)
    assert graph.is_equivalent_to(RuleParser().parse(same))
    assert warning in graph.warnings
    assert (graph.text, graph.task_id) == (text, task_id_of(text))


@pytest.mark.parametrize(
    ("text", "same"),
    [
        ("lost my vase lol chk the sofa", "Lost my vase. Check the sofa"),
        ("map the desk real good rest dont care", "Map the desk"),
        ("Pull the red jug apart from the blue jug", "Pull the red jug away from the blue jug"),
        ("Which direction is the vase relative to me?", "Which direction is the vase from me?"),
        ("grab the cup no just the plate", "Grab the cup, no, the plate"),
        ("Collect tools, for example a hammer", "Collect tools, a hammer"),
        ("Drive to the dock while avoiding people", "Drive to the dock, avoid people"),
        ("Find the mug. If not, wait for the nurse", "Find the mug. Wait for the nurse"),
        ("avoid the cat shes on the bed", "Avoid the cat, she is on the bed"),
    ],
)
def test_what_strangers_say_is_read_as_the_plain_sentence(text, same):
    assert RuleParser().parse(text).is_equivalent_to(RuleParser().parse(same))


@pytest.mark.parametrize(
    ("text", "lost"),
    [
        ("There is a victim behind the wall. Go to the door.", ["victim", "wall"]),
        ("Bring me a bottle of water and a bar of soap", []),
        ("I am hungry, get me the apple", []),
        ("Drive up to the ramp and bring the robot the cup", ["robot"]),
        ("Find the ball and carry the very fragile", ["fragile"]),
        ("Robot, inspect the pipe for cracks", []),
        ("Fly over the building with a sign to the tower", ["sign"]),
        ("Drone, zorquil the window of the garage", ["zorquil"]),
        ("Drop the parcels into the zone of the same colour", ["zone"]),
        ("Set the crate in the spot behind the van", []),
        ("The baby sleeps, so close the curtains because guests are coming", []),
    ],
)
def test_a_noun_that_the_graph_lacks_is_named_in_a_warning(text, lost):
    named = [warning for warning in RuleParser().parse(text).warnings if "is not part of the task" in warning]
    assert named == [f"{noun!r} is not part of the task" for noun in lost]


def test_spellings_of_one_task_have_one_id():
    assert task_id_of("Pick up  the Mug.") == task_id_of("pick up the mug")
    assert task_id_of("pick up the mug") != task_id_of("pick up the cup")
    assert len(task_id_of("x")) == 12


@pytest.mark.parametrize(
    ("plural", "one"),
    [
        ("chairs", "chair"), ("boxes", "box"), ("people", "person"), ("shelves", "shelf"), ("dishes", "dish"),
        ("batteries", "battery"), ("vases", "vase"), ("glass", "glass"), ("cactus", "cactus"), ("tomatoes", "tomato"),
        ("scissors", "scissors"), ("cookies", "cookie"), ("buses", "bus"), ("shoes", "shoe"), ("knives", "knife"),
    ],
)  # fmt: skip
def test_singulars(plural, one):
    assert singular(plural) == one


def test_the_validator_refuses_relations_between_unknown_nouns():
    graph = TaskGraph("id", "mug", ("mug",), (), (Relation(Predicate.ON, "mug", "table"),))
    pytest.raises(TaskError, require_graph, graph).match("expected one of the anchors last, got 'table'")


@pytest.mark.parametrize(
    ("text", "targets", "anchors"),
    [
        ("Find the map on the wall", ("map",), ("wall",)),
        ("Bring me the photo on the shelf", ("photo",), ("shelf",)),
        ("Fetch the list from the fridge", ("list",), ("fridge",)),
        ("Make a map of the table", ("table",), ()), ("Take a picture of the mug", ("mug",), ()),
        ("Find the model of the car", ("car",), ()), ("Extend the map around the sofa", ("sofa",), ()),
        ("Find the van in visitor parking", ("van",), ("visitor parking",)),
        ("Tidy up: stack plates on the rack", ("plate", "rack"), ()),
        ("Find the vases please get the jug avoid glass", ("vase", "jug", "glass"), ()),
        ("Drop the jug on the green area", ("jug", "area"), ()),
        ("take a cart to receiving and a jug to returns", ("cart", "receiving", "jug", "return"), ()),
    ],
)  # fmt: skip
def test_what_the_robot_handles_is_an_object_and_where_it_is_an_anchor(text, targets, anchors):
    graph = RuleParser().parse(text)
    assert (graph.targets, graph.anchors) == (targets, anchors)


@pytest.mark.parametrize(
    ("text", "target"),
    [
        ("Check the label printing table", "label printing table"), ("Find the pipe leaking water", "pipe"),
        ("Find the man pushing carts", "man"), ("Take the right most table", "table"),
        ("Circle the table at least 3 times", "table"), ("Someone knocked over the vase. Lift it", "vase"),
        ("Stack 4 of the red crates", "crate"), ("So there is a jug on the shelf", "jug"),
        ("Trash can is on the ramp", "trash can"), ("Prevent the robot to lift a jug, lift the vase", "vase"),
    ],
)  # fmt: skip
def test_the_words_of_a_compound_are_one_name(text, target):
    assert RuleParser().parse(text).targets == (target,)


FOREIGN = (
    "Bringe mir bitte die rote Tasse vom Tisch", "Nimm den Becher", "Ramasse la tasse rouge sur la table",
    "recoge la taza de la mesa", "print('hello world')", "SELECT * FROM tasks", "rm -rf / && echo cup",
    "for i in range(3): move(i)", "import numpy as np",
)  # fmt: skip
NO_OBJECT = ("", "   ", "asdf qwer", "pick up", "go and clean", "!?!", "12 34", "please", "Ignore the vase", "red")
MANY = [f"{colour} {noun}" for colour in ("red", "blue", "green") for noun in sorted(COMMON_ANCHORS)[:6]]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        *((text, r"expected .* names an object, such as") for text in (*NO_OBJECT, *FOREIGN)),
        ("find the m\udcffg", "expected UTF-8"),
        ("a" * 1001, "at most 1000 characters, got 1001"),
        (f"Find the {', the '.join(MANY)}", "at most 16 objects, got 18"),
        ("Find the " + "x" * 70, "at most 64 characters"),
    ],
)
def test_a_text_that_is_no_task_is_refused_in_one_line(text, message):
    with pytest.raises(TaskError, match=message) as caught:
        RuleParser().parse(text)
    assert "\n" not in str(caught.value)
