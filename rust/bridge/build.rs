fn main() {
    cxx_build::bridge("src/lib.rs")
        .std("c++17")
        .compile("glints_bridge_glue");
    println!("cargo:rerun-if-changed=src/lib.rs");
}
