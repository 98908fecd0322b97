"""What keeps the documentation true: commands that run, lists read off the code."""
