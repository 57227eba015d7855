"""Scenes of image-level streets."""

import numpy as np
import pytest

from monitor.scene_evidence import STREET_M, street_drive, street_scenes


def test_a_street_repeats_by_its_number_and_streets_differ() -> None:
    one, same, other = street_drive(1, 2), street_drive(1, 2), street_drive(1, 3)
    assert one.T_stored == pytest.approx(same.T_stored, abs=0.0)
    assert one.seed == same.seed != other.seed
    assert one.motion.speed * one.duration == pytest.approx(STREET_M)
    assert one.camera.width == 640


@pytest.mark.slow
def test_scenes_of_a_street_share_no_frames_and_are_near_the_truth() -> None:
    found = street_scenes(4711, 3)
    ways = [scene.way_m for scene in found]
    assert 3 <= len(found) <= 6
    assert np.all(np.diff(ways) >= 20.0)
    assert np.abs([scene.drift[:3] for scene in found]).max() < np.radians(1.0)
