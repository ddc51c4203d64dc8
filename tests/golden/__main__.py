"""Compares golden runs (the default), renews them on purpose or rewrites their recordings."""

from __future__ import annotations

import argparse
import logging
import sys
from pathlib import Path

from tests.golden.cases import CASES
from tests.golden.recordings import HEADS, path_to, write


def main() -> int:
    """0: all is as it is stored, or was renewed; 1: something moved."""
    parser = argparse.ArgumentParser(
        prog="python -m tests.golden",
        description="Play the golden recordings by the production path and compare with the stored references.",
        epilog="Example: python -m tests.golden --renew walk",
    )
    parser.add_argument("cases", nargs="*", metavar="CASE", help=f"which: {', '.join(CASES)} (default: all)")
    parser.add_argument("--renew", action="store_true", help="store the runs of now as the references")
    parser.add_argument("--record", action="store_true", help="make the recordings anew first (only with --renew)")
    parser.add_argument("--pictures", type=Path, default=Path("out/golden"), help="where panels that moved are shown")
    given = parser.parse_args()
    if unknown := [name for name in given.cases if name not in CASES]:
        parser.error(f"no case {unknown[0]!r}; known: {', '.join(CASES)}")
    if given.record and not given.renew:
        parser.error("--record needs --renew: other recordings, other references")
    logging.getLogger("phasestack").addHandler(logging.NullHandler())
    from tests.golden.references import check, renew

    if given.record:
        for name in HEADS:
            write(name, path_to(name))
    moved = 0
    for name in given.cases or CASES:
        lines = renew(name) if given.renew else check(name, pictures=given.pictures)
        moved += bool(lines)
        print("\n".join(lines) if lines else f"{name}: as it is stored")
    if given.renew:
        print(f"renewed: {len(given.cases or CASES)}; look at `git diff --stat tests/golden/data` before you commit it")
        return 0
    if moved:
        print("Something moved. If that is meant: make golden, and say why in the commit.")
    return 1 if moved else 0


if __name__ == "__main__":
    sys.exit(main())
