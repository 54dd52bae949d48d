"""For any text, the parser returns a graph within the limits or raises a one-line error."""

from hypothesis import example, given
from hypothesis import strategies as st

from gausslite.domain.errors import TaskError
from gausslite.domain.task import require_graph
from gausslite_language import lexicon
from gausslite_language.clause_types import MODALS, WISHES
from gausslite_language.grounding import task_id_of
from gausslite_language.lexicon import NOUNS, word_set
from gausslite_language.rules import RuleParser
from gausslite_language.tokens import PREPOSITIONS

WORDS = st.sampled_from(
    sorted(
        (
            lexicon.DETERMINERS
            | lexicon.ADVERBS
            | PREPOSITIONS.keys()
            | lexicon.INDEFINITE_PRONOUNS.keys()
            | MODALS
            | WISHES
        )
        | {" ".join(negation) for negation in lexicon.NEGATIONS}
        | word_set(
            "pick up put find avoid without not ignore the a red closest nearest to from on in of for with and or , / "
            "; : . ! + it them this that these mug table chairs map go door picture path is are was don't touching who "
            "which what where when while whether because so until then before after i you we they me her one "
            "ones everything put leave left right holding stands needs belong lost found u there's mug's 3 back up "
            "down out off largest nearest bigger than second neither nor isn't can't kitchen room 12 within 2 m metres "
            "half between at least from away far throw water avoid touching fill use wearing handle they should black"
        )
    )
)


@given(
    st.text(max_size=200)
    | st.lists(WORDS, max_size=25).map(" ".join)
    | st.builds(lambda words, times: " ".join(words) * times, st.lists(WORDS | st.text(), max_size=4), st.just(20_000))
)
@example("NOT")
def test_any_text_gives_a_valid_graph_or_one_line(text):
    try:
        graph = RuleParser().parse(text)
    except TaskError as error:
        message = str(error)
    else:
        require_graph(graph)
        message = ""
        assert graph.task_id == task_id_of(text)
    assert "\n" not in message


@given(st.sampled_from(sorted(NOUNS)), st.booleans())
def test_case_spaces_and_full_stops_do_not_matter(noun, loud):
    plain = f"find the {noun} on the shelf"
    typed = f"  {plain.upper() if loud else plain.capitalize()} .  "
    one, other = RuleParser().parse(plain), RuleParser().parse(typed)
    assert (one.task_id, one.targets, one.anchors, one.relations) == (
        other.task_id, other.targets, other.anchors, other.relations,
    )  # fmt: skip
