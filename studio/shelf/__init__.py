"""What the runs page is made of: marks, outcomes, traces, thumbnails and the trash."""
