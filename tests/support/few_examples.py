"""The number of examples of a property whose examples take long: a fourth of the others'."""

from hypothesis import settings

few_examples = settings(max_examples=settings.default.max_examples // 4)
