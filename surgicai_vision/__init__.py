"""Image-based imitation learning for robotic suturing.

The flow is the vocabulary: scene → env → demos → dataset → features → policy → evaluation → report.
Importing this package does nothing but name the version; `import surgicai_vision.envs` registers
the gymnasium ids.
"""

__version__ = "0.2.0"
