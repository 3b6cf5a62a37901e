"""A scene through the real nodes, and its replay beside what they said."""
