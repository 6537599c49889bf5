"""What MORPH is compared with: the same parts without the proxy."""
