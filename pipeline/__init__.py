"""Pure stages of the monitor: numpy arrays in, immutable values out."""
