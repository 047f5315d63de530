"""The fleet in Foxglove's app, over its WebSocket protocol: read-only."""
