"""Images that others took with real cameras, in folders with depth and poses: read, and flown again."""
