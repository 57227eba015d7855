"""What a frame costs, stage by stage: ``python -m tests.bench`` (``make bench``). No time is asserted."""
