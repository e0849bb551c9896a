"""Tables of accuracy and speed."""
