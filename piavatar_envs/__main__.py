"""``python -m piavatar_envs``."""

from piavatar_envs.cli import main

if __name__ == "__main__":
    main()
