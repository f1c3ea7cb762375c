"""What becomes of a frame, stage by stage; `torchslam.system.slam` says which stage has its turn.

following    -> the world at hand: track, judge, believe or hold back (`following`)
mapping      -> a believed frame enters the world, a keyframe grows its map (`local_mapping`)
on trial     -> of frames that are held back too, until they are confirmed or the camera is lost (`on_trial`)
seen before? -> adjusted keyframes are recognised, loops closed, worlds joined, rows let go of (`loop_closing`)
finding      -> without a world: relocalise in a known one, or begin a new one (`finding`, `beginning`)
the way back -> frames from before a world was known or found again get their poses (`tracking_back`)

Each file imports only those after it in that sense: following -> finding -> beginning -> tracking back -> mapping.
"""
