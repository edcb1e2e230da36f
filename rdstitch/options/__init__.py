"""What the user can choose: each option once, with its type, its default, its limits and its text."""
