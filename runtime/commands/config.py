"""`phasestack config`: print all settings with their defaults and descriptions."""

from __future__ import annotations


def config() -> None:
    """Print a complete configuration in TOML, with the default and a description for every setting.

    Relative paths are resolved against the configuration file's folder. To check a configuration, use `phasestack
    doctor --config FILE`.

    Example: phasestack config > phasestack.toml
    """
    import tomlkit

    from runtime.config import Settings

    defaults, document = Settings(), tomlkit.document()
    document.add(tomlkit.comment("Paths are relative to this file's folder."))
    for name, values in defaults.model_dump(mode="json").items():
        document.add(tomlkit.nl())
        document[name] = table = tomlkit.table()
        table.add(tomlkit.comment(type(getattr(defaults, name)).__doc__ or ""))
        for key, value in values.items():
            table.add(tomlkit.comment(type(getattr(defaults, name)).model_fields[key].description))
            if value is None:
                table.add(tomlkit.comment(f"{key} ="))
            elif isinstance(value, dict):
                table[key] = inline = tomlkit.inline_table()
                inline.update(value)
            else:
                table[key] = value
    print(tomlkit.dumps(document), end="")
