"""Write src/gausslite_language/sizes.txt, the lengths of kinds of things, from the asset database of ProcTHOR.

    python3 tools/object_sizes.py procthor/databases/asset-database.json > src/gausslite_language/sizes.txt

The file is in the package procthor (Allen Institute for AI, Apache-2.0): boxes of 1653 models of things in homes.
"""

from __future__ import annotations

import json
import re
import sys
from pathlib import Path

HEADER = """\
# Lengths of things in homes, from the asset database of ProcTHOR (Allen Institute for AI, Apache-2.0; see
# tools/object_sizes.py): a kind, and the longest side of its longest model in metres.\
"""


def main(database: Path) -> None:
    """Print one line per kind."""
    print(HEADER)
    for kind, models in json.loads(database.read_text()).items():
        lengths_m = [max(model["boundingBox"].values()) for model in models if model["boundingBox"]]
        noun = " ".join(re.findall(r"[A-Z][a-z]+|[A-Z]+(?![a-z])", kind)).lower()
        print(f"{noun}|{max(lengths_m):.2f}")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
