"""``python -m gpvo.cli``."""

from gpvo.cli import main

main()
