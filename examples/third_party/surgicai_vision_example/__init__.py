"""An encoder, a policy, a camera and a task for surgicai-vision; see the README."""
