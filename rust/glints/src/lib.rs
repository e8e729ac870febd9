//! Filtered distributions of normals for specular microstructure.
//!
//! Data flows one way: a [`normal_map::NormalMap`] is turned into a [`methods::Method`]'s structure, a
//! [`footprint::Footprint`] and a half vector query it, and [`brdf::Brdf`] turns the answer into a BRDF
//! value, a sample or a density, without Fresnel term and colour. The library knows no renderer and does no
//! FFI.
//!
//! Units and domains, everywhere: texels for lengths on the map (column along u, row along v, origin at the
//! corner of texel (0, 0)); unit vectors in the local shading frame, z the shading normal; densities per
//! solid angle.

mod array;
pub mod brdf;
mod container;
pub mod environment_file;
pub mod environment_map;
pub mod error;
pub mod flake_layer;
pub mod flake_map;
pub mod flakes;
pub mod footprint;
pub mod footprint_filter;
pub mod gaussian_footprint;
pub mod gtr;
pub mod half_vector;
pub mod half_vector_range;
mod hash;
pub mod lobe_range;
pub mod methods;
pub mod microfacet;
pub mod mip_map;
pub mod normal_map;
pub mod prefilter;
pub mod refinement;
pub mod saved;
pub mod spherical_gaussians;
