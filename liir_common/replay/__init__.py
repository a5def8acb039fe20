"""One battle of a frozen policy, recorded and shown: as a page to explore or as an animation."""
