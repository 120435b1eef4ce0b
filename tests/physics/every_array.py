"""Every array of mjModel and what a world makes of it; test_every_option.py compares the lists with MuJoCo."""

# What is as in C, by the test that shows it.
HONOURED = {
    "tests/physics/test_every_field.py::test_each_field_has_its_effect": (
        "actuator_acc0 actuator_actrange actuator_armature actuator_biasprm actuator_cranklength "
        "actuator_ctrlrange actuator_damping actuator_dampingpoly actuator_delay actuator_dynprm "
        "actuator_forcerange actuator_gainprm actuator_gear actuator_lengthrange body_gravcomp body_inertia "
        "body_invweight0 body_ipos body_iquat body_mass body_pos body_quat body_subtreemass cam_mat0 cam_pos "
        "cam_pos0 cam_poscom0 cam_quat dof_armature dof_damping dof_dampingpoly dof_frictionloss "
        "dof_invweight0 dof_solimp dof_solref eq_data eq_solimp eq_solref geom_adhesion geom_friction "
        "geom_gap geom_margin geom_pos geom_quat geom_rbound geom_size geom_solimp geom_solmix geom_solref "
        "geom_surfacevel jnt_actfrcrange jnt_axis jnt_margin jnt_pos jnt_range jnt_solimp jnt_solref "
        "jnt_springyield jnt_stiffness jnt_stiffnesspoly light_dir light_dir0 light_pos light_pos0 "
        "light_poscom0 pair_adhesion pair_friction pair_gap pair_margin pair_solimp pair_solref "
        "pair_solreffriction qpos0 qpos_spring sensor_delay sensor_interval site_pos site_quat "
        "tendon_actfrcrange tendon_armature tendon_damping tendon_dampingpoly tendon_frictionloss "
        "tendon_invweight0 tendon_lengthspring tendon_margin tendon_range tendon_solimp_fri tendon_solimp_lim "
        "tendon_solref_fri tendon_solref_lim tendon_springyield tendon_stiffness tendon_stiffnesspoly "
    ),
    "tests/benchmarks/judge/test_generated.py::test_a_model_is_as_in_c": (
        "actuator_actadr actuator_actearly actuator_actlimited actuator_actnum actuator_biastype "
        "actuator_ctrladr actuator_ctrllimited actuator_ctrlnum actuator_ctrlspec actuator_dyntype "
        "actuator_forcelimited actuator_gaintype actuator_group actuator_history actuator_historyadr "
        "actuator_outadr actuator_outnum actuator_trnid actuator_trntype body_dofadr body_dofnum body_geomadr "
        "body_geomnum body_jntadr body_jntnum body_mocapid body_parentid body_rootid body_simple body_treeid "
        "body_weldid cam_bodyid cam_mode cam_projection cam_resolution cam_sensorsize cam_targetbodyid "
        "dof_Madr dof_bodyid dof_jntid dof_parentid dof_treeid eq_active0 eq_obj1id eq_obj2id eq_objtype "
        "eq_type exclude_signature geom_aabb geom_bodyid geom_conaffinity geom_condim geom_contype "
        "geom_dataid geom_fluid geom_priority geom_type jnt_actfrclimited jnt_actgravcomp jnt_actuatorid "
        "jnt_bodyid jnt_dofadr jnt_limited jnt_plasticadr jnt_qposadr jnt_type key_act key_ctrl key_mpos "
        "key_mquat key_plastic key_qpos key_qvel key_time light_bodyid light_mode light_targetbodyid "
        "mesh_face mesh_faceadr mesh_facenum mesh_graph mesh_graphadr mesh_polyadr mesh_polymap "
        "mesh_polymapadr mesh_polymapnum mesh_polynormal mesh_polynum mesh_polyvert mesh_polyvertadr "
        "mesh_polyvertnum mesh_pos mesh_quat mesh_vert mesh_vertadr mesh_vertnum pair_dim pair_geom1 "
        "pair_geom2 sensor_adr sensor_cutoff sensor_datatype sensor_dim sensor_history sensor_historyadr "
        "sensor_intprm sensor_needstage sensor_objid sensor_objtype sensor_refid sensor_reftype sensor_type "
        "site_bodyid site_size site_type ten_J_colind ten_J_rowadr ten_J_rownnz tendon_actfrclimited "
        "tendon_actuatorid tendon_adr tendon_length0 tendon_limited tendon_num tendon_plasticadr tendon_type "
        "tree_bodynum tree_dofadr tree_dofnum wrap_objid wrap_prm wrap_type "
    ),
    "tests/benchmarks/judge/test_rare_models.py::test_a_rare_model_is_as_in_c": (
        "flex_activelayers flex_bending flex_bendingadr flex_cellnum flex_centered flex_conaffinity "
        "flex_condim flex_contype flex_damping flex_dim flex_edge flex_edgeadr flex_edgedamping "
        "flex_edgeequality flex_edgeflap flex_edgenum flex_edgestiffness flex_elem flex_elemadr "
        "flex_elemdataadr flex_elemedge flex_elemedgeadr flex_elemlayer flex_elemnum flex_friction "
        "flex_gap flex_interp flex_margin flex_node flex_node0 flex_nodeadr flex_nodebodyid flex_nodenum "
        "flex_passive flex_plasticadr flex_plasticmode flex_priority flex_radius flex_rigid "
        "flex_selfcollide flex_shell flex_shelldataadr flex_shellnum flex_size flex_solimp flex_solmix "
        "flex_solref flex_stiffness flex_stiffnessadr flex_vert flex_vert0 flex_vertadr flex_vertbodyid "
        "flex_vertcell flex_vertnum flex_yield flexedge_J_colind flexedge_J_rowadr flexedge_J_rownnz "
        "flexedge_invweight0 flexedge_length0 flexedge_rigid mesh_octadr mesh_octnum oct_aabb oct_child "
        "oct_coeff oct_depth "
    ),
    "tests/physics/test_asleep.py::test_trees_fall_asleep_as_in_c": ("tree_sleep_policy "),
    "tests/physics/test_sensor_mending.py::test_what_is_in_a_site_with_a_mesh_is_refused": (
        "site_dataid "
    ),
    "tests/physics/test_height_fields.py": (
        "hfield_adr hfield_data hfield_ncol hfield_nrow hfield_size "
    ),
}
# What is refused by name, by the kind that REFUSED of test_every_option.py shows.
REFUSED = {
    "plugin": (
        "actuator_plugin body_plugin geom_plugin plugin plugin_attr plugin_attradr plugin_stateadr "
        "plugin_statenum sensor_plugin "
    ),
}
# What no physics reads, by what it is for.
WITHOUT_MEANING = {
    "how C searches and stores, in tables of its own": (
        "B_colind B_rowadr B_rownnz D_colind D_diag D_rowadr D_rownnz M_colind M_rowadr M_rownnz "
        "actuator_length0 body_bvhadr body_bvhnum body_conaffinity body_contype body_margin body_sameframe "
        "bvh_aabb bvh_child bvh_depth bvh_nodeid dof_M0 dof_length dof_simplenum efm0_L efm0_L_colind "
        "efm0_L_rowadr efm0_L_rownnz efm0_dofid efmC_perm flex_bvhadr flex_bvhnum geom_sameframe mapD2M "
        "mapM2D mapM2M mesh_bvhadr mesh_bvhnum mesh_extrema mesh_scale pair_signature site_sameframe "
        "tendon_treeid tendon_treenum tree_bodyadr "
    ),
    "names, paths and data of the user": (
        "actuator_user body_user cam_user geom_user hfield_pathadr jnt_user mesh_pathadr name_actuatoradr "
        "name_bodyadr name_camadr name_eqadr name_excludeadr name_flexadr name_geomadr name_hfieldadr "
        "name_jntadr name_keyadr name_lightadr name_matadr name_meshadr name_numericadr name_pairadr "
        "name_pluginadr name_sensoradr name_siteadr name_skinadr name_tendonadr name_texadr name_textadr "
        "name_tupleadr names_map numeric_adr numeric_data numeric_size sensor_noise sensor_user site_user "
        "tendon_user text_adr text_size tuple_adr tuple_objid tuple_objprm tuple_objtype tuple_size "
    ),
    "of pictures alone": (
        "cam_fovy cam_intrinsic cam_ipd cam_output flex_elemtexcoord flex_flatskin flex_group flex_matid "
        "flex_rgba flex_texcoord flex_texcoordadr geom_castshadow geom_group geom_matid geom_rgba jnt_group "
        "light_active light_ambient light_attenuation light_bulbradius light_castshadow light_cutoff "
        "light_diffuse light_exponent light_intensity light_range light_softness light_specular light_texid "
        "light_type mat_emission mat_metallic mat_reflectance mat_rgba mat_roughness mat_shininess "
        "mat_specular mat_texid mat_texrepeat mat_texuniform mesh_facenormal mesh_facetexcoord mesh_normal "
        "mesh_normaladr mesh_normalnum mesh_texcoord mesh_texcoordadr mesh_texcoordnum site_group site_matid "
        "site_rgba skin_boneadr skin_bonebindpos skin_bonebindquat skin_bonebodyid skin_bonenum "
        "skin_bonevertadr skin_bonevertid skin_bonevertnum skin_bonevertweight skin_face skin_faceadr "
        "skin_facenum skin_group skin_inflate skin_matid skin_pathadr skin_rgba skin_texcoord "
        "skin_texcoordadr skin_vert skin_vertadr skin_vertnum tendon_group tendon_matid tendon_rgba "
        "tendon_width tex_adr tex_colorspace tex_contenttypeadr tex_data tex_height tex_nchannel tex_pathadr "
        "tex_type tex_width "
    ),
}
# What nothing here compares with C yet.
NOT_COMPARED: dict[str, str] = {}
