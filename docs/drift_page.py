"""Renews tables and pictures of docs/drift.md: ``python docs/drift_page.py out/drift docs``.

Each block between ``<!-- NAME -->`` and ``<!-- end -->`` is what ``calibwatch evaluate drift`` wrote into the
folder NAME; a block whose folder is absent stays as it is. Pictures are shown of simulation only.
"""

import re
import shutil
import sys
from pathlib import Path

PICTURED = "simulated"

CAPTIONS = {
    "calling": "ROC of the joint statistic, and share told over time",
    "axes": "share told with one axis wrong",
    "stanford": "error against protection level",
}


def main() -> None:
    """Copies pictures and puts tables in place."""
    results, docs = Path(sys.argv[1]), Path(sys.argv[2])
    page = docs / "drift.md"
    text = re.sub(
        r"(<!-- (?!end)(\w+) -->\n)(.*?)(?=<!-- end -->)",
        lambda block: block[1] + _block(results / block[2], docs, block[3]),
        page.read_text(encoding="utf-8"),
        flags=re.DOTALL,
    )
    page.write_text(text, encoding="utf-8")


def _block(folder: Path, docs: Path, before: str) -> str:
    """Tables and pictures of a folder, or what stood there before."""
    tables = folder / "drift.md"
    if not tables.exists():
        return before
    parts = [tables.read_text(encoding="utf-8").strip()]
    for name, caption in CAPTIONS.items():
        source = folder / f"drift_{name}.png"
        if folder.name == PICTURED and source.exists():
            shutil.copyfile(source, docs / source.name)
            parts.append(f"![{caption}]({source.name})")
    return "\n" + "\n\n".join(parts) + "\n\n"


if __name__ == "__main__":
    main()
