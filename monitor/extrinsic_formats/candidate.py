"""``<pair>.candidate.json``: an extrinsic that calibwatch proposed, taken by a person who accepts it."""

from monitor.candidate_file import SCHEMA, verified
from monitor.extrinsic_formats import Choice, Document, Format, Reading, defined, directed, rigid, table


class CandidateFormat:
    """calibwatch.candidate/1."""

    name = "candidate"
    title = "extrinsic proposed by calibwatch"

    def matches(self, document: Document) -> bool:
        """An object with this ``schema``."""
        return table(document.data).get("schema") == SCHEMA

    def read(self, document: Document, choice: Choice) -> Reading:
        """The matrix, once the file was held against its hash."""
        candidate = verified(document.text.encode(), str(document.path))
        direction = defined(choice, "T_cam_lidar", "by its key")
        rows = [list(row) for row in candidate.T_cam_lidar]
        T, read_as = directed(rigid(rows, "T_cam_lidar"), direction, "by its key")
        replaced = candidate.replaces.hash or "one without a hash"
        notes = [
            f"its hash {candidate.hash} fits what it says",
            f"it replaces {replaced}, against which the mount of {candidate.vehicle} has moved",
            f"better on frames held out: by chance with probability {candidate.hold_out.p_better:.2g}",
        ]
        if not candidate.agreed:
            notes.append("it rests on fewer than three windows that share no objects: drive on, and compare")
        notes.append(
            "topics, limits, vehicle frame are not in it: copy T_cam_lidar into the rig file that is in use"
        )
        return Reading(T, read_as, name=candidate.pair, notes=tuple(notes))


FORMAT: Format = CandidateFormat()
