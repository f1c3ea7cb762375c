"""The SLAM system: its state machine, sessions, runs and checkpoints.

`slam` is the entry point; `state_machine` initializes, tracks, closes loops and relocalizes; `local_mapping` inserts
keyframes, `tentative_mapping` those of poses that are still uncertain; `backward_tracking` poses earlier frames.
"""
