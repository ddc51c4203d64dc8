"""Entry point of `python -m phasestack`, which is the command `phasestack`."""

from runtime.cli import main

if __name__ == "__main__":
    main()
