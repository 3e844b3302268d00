"""``python -m rce.ros.tools topic list``: the tools without the rest of the engine's commands."""

from rce.ros.tools.program import main

if __name__ == "__main__":
    main()
