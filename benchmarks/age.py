"""How old measured figures are: commit, date and machine of each file, and what has changed since in the code that it
measures.

    python benchmarks/age.py             lists every file
    python benchmarks/age.py --changed   warns about those whose code has changed; `make check` does

It never fails: figures are taken anew when there is time for it, and a shallow clone cannot tell.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from dataclasses import dataclass

from registry import FIGURES, ROOT, Figures, described, heads


@dataclass(frozen=True)
class Age:
    """How one file stands. `since` says in words what has changed, or why nobody can tell; empty: nothing has."""

    file: Figures
    origin: str
    since: str


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n\n")[0])
    parser.add_argument("--changed", action="store_true", help="warn about those whose code has changed, no more")
    given = parser.parse_args()
    if given.changed and (reason := why_unknown()):
        sys.stdout.write(f"warning: whether measured figures are current is not known: {reason}\n")
        return
    for age in map(age_of, FIGURES.values()):
        if not given.changed:
            sys.stdout.write(f"{age.file.path}: {age.origin or 'not measured yet'}\n")
            if age.origin:
                sys.stdout.write(f"    {age.since or 'nothing that it measures has changed since'}\n")
        elif age.since:
            sys.stdout.write(f"warning: {age.file.path}: {age.since} (make {age.file.target} RECORD=1)\n")


def why_unknown() -> str:
    """Why the history does not tell the age of figures; empty where it does."""
    if git("rev-parse", "HEAD") is None:
        return "there is no git checkout here"
    return "the clone is shallow" if git("rev-parse", "--is-shallow-repository") == "true" else ""


def age_of(file: Figures) -> Age:
    """The age of a file; of each of its commits where it has several."""
    if not file.kept.exists():
        return Age(file, "", "")
    found = list(heads(json.loads(file.kept.read_text(encoding="utf-8"))))
    if reason := why_unknown():
        since = f"whether the code has changed is not known: {reason}"
    else:
        told = [changes_since(commit, file.measures) for commit in sorted({str(head["commit"]) for head in found})]
        uncommitted = "uncommitted changes" if git("status", "--porcelain", "--", *file.measures) else ""
        since = "; ".join(part for part in (*told, uncommitted) if part)
    return Age(file, described(iter(found)), since)


def changes_since(commit: str, paths: tuple[str, ...]) -> str:
    """What has changed in some paths since a commit, in words; empty: nothing."""
    clean = commit.removesuffix("-dirty")
    if git("cat-file", "-e", f"{clean}^{{commit}}") is None:
        return f"whether the code has changed is not known: commit {clean} is not in this clone"
    count = int(git("rev-list", "--count", f"{clean}..HEAD", "--", *paths) or 0)
    commits = f"{count} commit{'s'[: count != 1]} changed what it measures since {clean}" if count else ""
    unclean = f"measured with uncommitted changes to {clean}" if commit != clean else ""
    return ", ".join(part for part in (unclean, commits) if part)


def git(*words: str) -> str | None:
    """What a git command prints about the checkout; None where it fails or there is no git."""
    command = ["git", "--no-optional-locks", "-C", str(ROOT), *words]
    try:
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        return None


if __name__ == "__main__":
    main()
