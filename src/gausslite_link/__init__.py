"""What a program beside an agent or a server keeps running: a link for frames and tasks, and a follower of its map."""
