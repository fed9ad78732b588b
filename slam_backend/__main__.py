"""`python -m slam_backend`: the same as `slam-backend`."""

from slam_backend.cli import main

raise SystemExit(main())
