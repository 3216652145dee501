"""``python -m gpvo.cli``."""

from gpvo.__main__ import main

main()
