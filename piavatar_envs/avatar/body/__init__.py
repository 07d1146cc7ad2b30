"""The body: skeleton, flesh and skin, sampled into particles; begin with :mod:`piavatar_envs.avatar.body.asset`."""
