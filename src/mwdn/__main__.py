"""``python -m mwdn`` is ``mwdn``."""

from mwdn.cli import main

if __name__ == "__main__":
    main()
