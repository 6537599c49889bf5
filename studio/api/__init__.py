"""The HTTP interface: one router per noun. Bodies and answers are the messages of morph_core.protocol."""
