"""``python -m rdstitch_cli``, where the script ``rdstitch`` is not on the path."""

from rdstitch_cli.main import main

if __name__ == "__main__":
    main()
