"""What run folders say together: tables over methods and scenes, and one page with pictures, curves and provenance."""
