"""How a robot drives: costmaps, planners, ``move_base``, the safety stage, exploration. Pure."""
