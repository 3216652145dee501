"""``python -m gpvo``: the command line, where its script is not on the path."""

from gpvo.cli import main

if __name__ == "__main__":
    main()
