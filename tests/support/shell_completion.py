"""What a real shell offers for typed lines, after it has read a program's completion script."""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Sequence
from pathlib import Path

import pytest

_LIMIT_S = 120
_BASH = """
compopt() { :; }
source "$1"; shift
for COMP_LINE; do
  COMP_WORDS=(); while read -r -d ' ' word; do COMP_WORDS+=("$word"); done <<< "$COMP_LINE "
  COMP_CWORD=$((${#COMP_WORDS[@]} - 1)); COMP_POINT=${#COMP_LINE}; COMPREPLY=()
  function=$(complete -p "${COMP_WORDS[0]}" | sed -E 's/.*-F ([^ ]+).*/\\1/')
  "$function" "${COMP_WORDS[0]}" "${COMP_WORDS[COMP_CWORD]}" "${COMP_WORDS[COMP_CWORD-1]}"
  printf '%s\\n' "${COMPREPLY[@]}"; echo "<end>"
done
"""
_ZSH = """
zmodload zsh/zpty
zpty shell "TERM=dumb zsh -f -i"
zpty -w shell 'PS1=; fpath=('${(q)1:h}' $fpath); autoload -Uz compinit; compinit -D -u
all-matches() { _main_complete; compstate[insert]=all; compstate[list]= }
zle -C all-matches complete-word all-matches; bindkey "^I" all-matches
report() { print -r -- "<<<$BUFFER>>>"; BUFFER= }; zle -N report; bindkey "^X" report; print rea""dy'
zpty -r shell output '*ready*'
shift
for line; do
  zpty -w -n shell $line$'\\t\\x18'
  zpty -r shell output '*<<<*>>>*'
  completed=${${output##*<<<}%%>>>*}
  print -l -- ${=completed#${line% *}} "<end>"
done
"""
"""An interactive zsh on a terminal of its own: Tab inserts all matches, Ctrl-X prints the line."""
_FISH = """
source $argv[1]
for line in $argv[2..]
  complete -C"$line"; echo "<end>"
end
"""
_COMMANDS = {
    "bash": ("bash", "--norc", "-c", _BASH, "bash"),
    "zsh": ("zsh", "-f", "-c", _ZSH, "zsh"),
    "fish": ("fish", "--no-config", "-c", _FISH),
}


def completions(shell: str, script: str, lines: Sequence[str], folder: Path) -> list[set[str]]:
    """Return what the shell offers at the end of each line of one program; skip the test without the shell."""
    if shutil.which(shell) is None:
        pytest.skip(f"needs {shell}")
    program = lines[0].partition(" ")[0]
    path = folder / "scripts" / f"_{program}"  # zsh finds the script by this name
    path.parent.mkdir(exist_ok=True)
    path.write_text(script)
    command = [*_COMMANDS[shell], str(path), *lines]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=_LIMIT_S)
    assert (done.returncode, done.stderr) == (0, "")
    answers = done.stdout.split("<end>\n")[:-1]
    # fish adds a description after a tab
    return [{offer.partition("\t")[0].strip() for offer in answer.splitlines()} - {""} for answer in answers]
