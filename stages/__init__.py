"""One file a stage."""


def run(main, name: str, loop: str = "") -> None:
    """Runs a stage."""
    main()
