from tests import shapes as shapes  # pytest finds it by the name in pyproject.toml
