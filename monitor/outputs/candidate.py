"""``<pair>.candidate.json``: the extrinsic proposed for a pair, for a person to accept."""

from pathlib import Path

from monitor.candidate_file import SUFFIX
from monitor.events import Event, ProposalEvent
from monitor.outputs import OutputKind, folder_of, write_whole


class CandidateFiles:
    """Keeps for each pair the file of what is proposed; none where nothing is proposed any more."""

    def __init__(self, folder: Path) -> None:
        folder.stat()  # a folder that is not there fails now, not when there is something to write
        self._folder = folder

    @property
    def lost(self) -> str | None:
        """Never: a failed write is raised where it happens."""
        return None

    def handle(self, event: Event) -> None:
        """Writes a proposal at once; takes back one that does not hold."""
        if not isinstance(event, ProposalEvent):
            return
        path = self._folder / f"{event.pair}{SUFFIX}"
        if event.document is None:
            path.unlink(missing_ok=True)
        else:
            write_whole(path, event.document.to_json())

    def close(self) -> None:
        """Nothing is held."""


OUTPUT = OutputKind("candidate", "folder", lambda surroundings: CandidateFiles(folder_of(surroundings)))
