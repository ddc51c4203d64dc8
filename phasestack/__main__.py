"""Run the `phasestack` command as `python -m phasestack`."""

from runtime.cli import main

if __name__ == "__main__":
    main()
