"""Watches whether the extrinsic between LiDAR and camera still holds: everything that touches the world."""
