"""What is shown of results, by capability: its screen and JSON, and beside it its page, which needs no network."""
