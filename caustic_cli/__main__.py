"""`python -m caustic_cli` is the `caustic` command."""

from caustic_cli.cli import main

if __name__ == "__main__":
    main()
