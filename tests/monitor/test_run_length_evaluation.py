"""``calibwatch evaluate run-length`` in short."""

import json
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from monitor.commands.evaluate_run_length import command
from monitor.run_length_evaluation import RunLength, Told, Tracked, fitted_to, summarised
from monitor.run_length_tables import run_length_text
from pipeline.run_length import AlarmBudget
from pipeline.simulation.evidence import EvidenceModel, scenes
from pipeline.simulation.long_drives import HealthyDrive


def test_tables_say_what_was_counted_what_was_extrapolated_and_what_was_not_told() -> None:
    budget, rng = AlarmBudget(), np.random.default_rng(1)
    statistics = np.zeros(20_000)
    statistics[100::100] = 13.5 + rng.exponential(2.0, 199)
    drive = HealthyDrive(36_000.0, np.full(20_000, 4.0), statistics, np.full(20_000, 52.0), statistics)
    healthy = summarised([drive], budget, rng)
    assert healthy.alarms == 0
    assert healthy.lowered[0].counted == np.sum(statistics > 16.0)
    assert healthy.extrapolated_hourly is not None
    told = Told(
        world="stored", axis="yaw", size=0.1, ramp=False, runs=2, told=0, early=0, seconds=None, way_m=None
    )
    tracked = Tracked(world="stored", hours=1.0, rms=(0.02,) * 6, sigma=(0.03,) * 6, within_two=0.95)
    fitted = fitted_to([list(scenes(EvidenceModel(), 12.0, lambda _: np.zeros(6), rng)) for _ in range(8)])
    text = run_length_text(
        RunLength(seed=1, fitted=fitted, healthy=healthy, told=(told,), tracked=(tracked,))
    )
    assert "10 h in 1 drives, 20000 scenes, 0 false alarms" in text
    assert "Image-level streets: 8" in text
    assert "Extrapolated, not counted" in text
    assert "| stored | yaw 0.1 deg | 0 of 2 | 0 |  |  |" in text
    assert "0.020 (0.030) deg" in text


@pytest.mark.slow
def test_a_short_run_counts_writes_and_repeats(tmp_path: Path) -> None:
    arguments = ["--hours", "1", "--runs", "1", "--seed", "3"]
    first = CliRunner().invoke(command, [*arguments, "--out", str(tmp_path)])
    assert first.exit_code == 0, first.output
    found = json.loads((tmp_path / "run-length.json").read_text())
    assert found["healthy"]["alarms"] == 0
    assert found["healthy"]["scenes"] > 500
    assert len(found["told"]) == 38
    assert all(one["early"] == 0 for one in found["told"])
    told = {(one["world"], one["axis"], one["size"], one["ramp"]): one["told"] for one in found["told"]}
    assert told["baseline", "yaw", 0.5, False] == 1
    assert "false alarms of the sum" in first.output
    assert (tmp_path / "run-length.md").read_text().strip() == first.output.strip()
