"""What the parts of a document that we hand out have in common: nothing in them changes, or is unknown."""

from pydantic import BaseModel, ConfigDict


class DocumentPart(BaseModel):
    """A part of a document with a committed JSON schema: numbers are finite or null, no key is unknown."""

    model_config = ConfigDict(
        frozen=True,
        extra="forbid",
        allow_inf_nan=False,
        validate_by_name=True,
        serialize_by_alias=True,
        json_schema_serialization_defaults_required=True,
    )
