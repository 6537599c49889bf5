# For vulture: names that only others read. Each stands under the reason why it is no dead code.

# MuJoCo reads what is set on a spec, a model or an option.
_.conaffinity
_.contype
_.ctrllimited
_.degree
_.disableflags
_.explicitinertial
_.forcelimited
_.forcerange
_.fromto
_.fullinertia
_.intprm
_.ipos
_.ls_iterations
_.modelname
_.savecompiled

# viser reads what is set on a handle.
_.animated
_.batched_colors
_.batched_positions
_.batched_scales
_.batched_wxyzs
_.color
_.disabled
_.fov
_.icon
_.look_at

# zipfile and trimesh read these.
_.compress_type
_.external_attr
_.visual

# Fields of messages and records: written here, read by a browser, another program or a person.
_.caption
_.commands_sha256
_.confidence
_.cosine_negative
_.design_sigma
_.deterministic_return
_.deterministic_solved_cpu_seconds
_.deterministic_solved_steps
_.end_is_final
_.export_versions
_.last_seq
_.method_titles
_.mime_type
_.part_count
_.part_index
_.phase
_.phi_moved
_.policy_iteration
_.policy_std
_.purged
_.size_bytes
_.source_component_uuid
_.submitted
_.transfer_uuid
_.writing

# Options of Slurm, read by their name.
_.account
_.constraint

# Asked for by name: the websocket by the server, what becomes of a broken pipe by rich, the environments by Gymnasium and by other libraries.
_.bridge
_.on_broken_pipe
_.TaskEnv
_.TaskVectorEnv
_.np_random_seed
_.observation_space
_.render

# Tests look through them.
_.charts
_.verify

# Classes that the catalogue finds in their folder, by name.
_.CmaesRl
_.Gaussian
_.GaussianIid
_.Gradient
_.MouseClick
_.PenPress
_.RandomWalk
_.Reacher
_.Scatter
_.Throw
_.Transform2Act
_.Uniform
_.ValueGradient

# Python and torch ask for these.
_.__dir__
_.__getattr__
_.forward
_.memo

# The command line reads them in the JSON that a replay prints.
_.recorded_on
_.replayed_on

# The page reads it in the JSON that tells what its viewer shows.
_.connected

# msgspec holds what a browser tells of its camera against them.
_.image_height
_.image_width
_.up_direction

# viser asks a message for these.
_.entity_state_key
_.redundancy_key

# rich calls it.
_.on_broken_pipe

# ONNX Runtime reads what is set on its options.
_.intra_op_num_threads

# Tests go by these: how the lines that load a file are run, and from which length on all joints have their room.
_.language
_.roomy

# Jupyter asks for the first two; notebooks call the rest.
_._repr_html_
_._repr_svg_
_.export
_.open_study
_.plot
_.train
_.view
