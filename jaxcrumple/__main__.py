"""`python -m jaxcrumple`: the command line."""

from jaxcrumple.cli.cli import main

if __name__ == "__main__":
    main()
