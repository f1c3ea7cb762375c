"""The SLAM system: pipeline, state machine, sessions, runs and checkpoints.

`slam` has the pipeline of a frame; `state_machine` tracks, relocalizes, initializes and closes loops; `local_mapping`
adds frames and keyframes to the map; `session` has the components; `run` processes a sequence.
"""
