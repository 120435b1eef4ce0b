"""The arrays of a model and its worlds that contacts of height fields are made of."""

MODEL_FIELDS = (
    "geom_type geom_condim geom_dataid geom_priority geom_solmix geom_solref geom_solimp geom_size geom_rbound "
    "geom_friction geom_margin geom_gap geom_adhesion hfield_size hfield_nrow hfield_ncol hfield_adr hfield_data "
    "pair_dim pair_solref pair_solreffriction pair_solimp pair_margin pair_gap pair_adhesion pair_friction"
)
DATA_FIELDS = "geom_xpos geom_xmat naconmax nacon overflow"
CONTACT_FIELDS = (
    "dist pos frame includemargin friction solref solreffriction solimp dim geom efc_address worldid type "
    "geomcollisionid adhesion"
)
