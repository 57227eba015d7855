"""Renews tables and pictures of docs/crlf.md: ``python docs/crlf_page.py out/crlf docs``.

Each block between ``<!-- NAME -->`` and ``<!-- end -->`` is what a command wrote into the folder NAME; a
block whose folder is absent stays as it is.
"""

import re
import shutil
import sys
from pathlib import Path

PER_FRAME = "Error / sigma of each answer"
"""How the longest section begins; shown for recorded frames only."""


def main() -> None:
    """Copies pictures and puts tables in place."""
    results, docs = Path(sys.argv[1]), Path(sys.argv[2])
    page = docs / "crlf.md"
    text = re.sub(
        r"(<!-- (?!end)(\w+) -->\n).*?(?=<!-- end -->)",
        lambda block: block[1] + _block(results / block[2], docs, block[0].removeprefix(block[1])),
        page.read_text(encoding="utf-8"),
        flags=re.DOTALL,
    )
    page.write_text(text, encoding="utf-8")


def _block(folder: Path, docs: Path, before: str) -> str:
    """Tables and picture of a folder, or what stood there before."""
    tables = sorted(folder.glob("*.md"))
    if not tables:
        return before
    picture = f"crlf_{folder.name}.png"
    shutil.copyfile(tables[0].with_suffix(".png"), docs / picture)
    sections = tables[0].read_text(encoding="utf-8").strip().split("\n\n")
    if folder.name != "recorded":
        sections = _without_frames(sections)
    return "\n" + "\n\n".join(sections) + f"\n\n![cumulative errors]({picture})\n\n"


def _without_frames(sections: list[str]) -> list[str]:
    """The sections less the table of single answers, whose head and rows are two sections."""
    kept = []
    skip = 0
    for section in sections:
        if section.startswith(PER_FRAME):
            skip = 2
        if skip:
            skip -= 1
        else:
            kept.append(section)
    return kept


if __name__ == "__main__":
    main()
