"""The studies that come with the project."""
