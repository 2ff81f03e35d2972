"""Run the command line as `python -m jaxcrumple`."""

from jaxcrumple.cli.cli import main

if __name__ == "__main__":
    main()
