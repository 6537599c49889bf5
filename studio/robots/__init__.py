"""Robots as things: their parts, what must be bought for them, and the programs that run their policies."""
