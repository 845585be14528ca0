//! Samples in the type of the file.

/// Samples in the type of the file. x fastest.
#[derive(Clone, Debug, PartialEq)]
#[allow(missing_docs, reason = "the variants are the element types")]
pub enum Samples {
    U8(Vec<u8>),
    I8(Vec<i8>),
    U16(Vec<u16>),
    I16(Vec<i16>),
    U32(Vec<u32>),
    I32(Vec<i32>),
    U64(Vec<u64>),
    I64(Vec<i64>),
    F32(Vec<f32>),
    F64(Vec<f64>),
}

/// The element type of [`Samples`].
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[allow(missing_docs, reason = "the variants are the element types")]
pub enum ElementType {
    U8,
    I8,
    U16,
    I16,
    U32,
    I32,
    U64,
    I64,
    F32,
    F64,
}

/// Byte order of a file.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[allow(missing_docs, reason = "the variants say it")]
pub enum Endian {
    Little,
    Big,
}

/// Runs `$body` with `$v` bound to the vector inside a [`Samples`].
macro_rules! each_sample_type {
    ($samples:expr, $v:ident => $body:expr) => {
        match $samples {
            $crate::volume::Samples::U8($v) => $body,
            $crate::volume::Samples::I8($v) => $body,
            $crate::volume::Samples::U16($v) => $body,
            $crate::volume::Samples::I16($v) => $body,
            $crate::volume::Samples::U32($v) => $body,
            $crate::volume::Samples::I32($v) => $body,
            $crate::volume::Samples::U64($v) => $body,
            $crate::volume::Samples::I64($v) => $body,
            $crate::volume::Samples::F32($v) => $body,
            $crate::volume::Samples::F64($v) => $body,
        }
    };
}

pub(crate) use each_sample_type;

impl ElementType {
    /// Every one.
    pub(super) const ALL: [Self; 10] =
        [Self::U8, Self::I8, Self::U16, Self::I16, Self::U32, Self::I32, Self::U64, Self::I64, Self::F32, Self::F64];

    /// Bytes per element.
    pub fn size(self) -> usize {
        match self {
            ElementType::U8 | ElementType::I8 => 1,
            ElementType::U16 | ElementType::I16 => 2,
            ElementType::U32 | ElementType::I32 | ElementType::F32 => 4,
            ElementType::U64 | ElementType::I64 | ElementType::F64 => 8,
        }
    }

    /// Bytes of `count` elements, `u64::MAX` if there are more.
    pub fn bytes(self, count: usize) -> u64 {
        (count as u64).saturating_mul(self.size() as u64)
    }

    /// The name used on the command line and in messages: `u8`, `i16`, `f32` …
    pub fn name(self) -> &'static str {
        match self {
            ElementType::U8 => "u8",
            ElementType::I8 => "i8",
            ElementType::U16 => "u16",
            ElementType::I16 => "i16",
            ElementType::U32 => "u32",
            ElementType::I32 => "i32",
            ElementType::U64 => "u64",
            ElementType::I64 => "i64",
            ElementType::F32 => "f32",
            ElementType::F64 => "f64",
        }
    }

    /// The type of a [`ElementType::name`].
    pub fn from_name(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|t| t.name() == name)
    }
}

impl Samples {
    /// Decodes raw bytes. `bytes.len()` must be a multiple of the element size; the rest is ignored.
    pub fn from_bytes(bytes: &[u8], element: ElementType, endian: Endian) -> Self {
        macro_rules! decode {
            ($t:ty) => {
                bytes
                    .chunks_exact(std::mem::size_of::<$t>())
                    .map(|b| {
                        let b = b.try_into().expect("chunks_exact gives whole elements");
                        match endian {
                            Endian::Little => <$t>::from_le_bytes(b),
                            Endian::Big => <$t>::from_be_bytes(b),
                        }
                    })
                    .collect()
            };
        }
        match element {
            ElementType::U8 => Samples::U8(bytes.to_vec()),
            ElementType::I8 => Samples::I8(decode!(i8)),
            ElementType::U16 => Samples::U16(decode!(u16)),
            ElementType::I16 => Samples::I16(decode!(i16)),
            ElementType::U32 => Samples::U32(decode!(u32)),
            ElementType::I32 => Samples::I32(decode!(i32)),
            ElementType::U64 => Samples::U64(decode!(u64)),
            ElementType::I64 => Samples::I64(decode!(i64)),
            ElementType::F32 => Samples::F32(decode!(f32)),
            ElementType::F64 => Samples::F64(decode!(f64)),
        }
    }

    /// [`Samples::from_bytes`] that keeps the buffer where its bytes are the samples.
    pub fn from_vec(bytes: Vec<u8>, element: ElementType, endian: Endian) -> Self {
        match element {
            ElementType::U8 => Samples::U8(bytes),
            _ => Self::from_bytes(&bytes, element, endian),
        }
    }

    /// Half-precision numbers, from their bits.
    pub fn from_halves(bits: &[u16]) -> Self {
        Samples::F32(bits.iter().map(|&b| half::f16::from_bits(b).to_f32()).collect())
    }

    /// Number of samples.
    pub fn len(&self) -> usize {
        each_sample_type!(self, v => v.len())
    }

    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Sample `i` as f64 (64-bit integers beyond 2⁵³ round to nearest).
    #[inline]
    #[allow(clippy::unnecessary_cast, reason = "the macro's f64 arm casts to itself")]
    pub fn get(&self, i: usize) -> f64 {
        each_sample_type!(self, v => v[i] as f64)
    }

    /// The element type.
    pub fn element_type(&self) -> ElementType {
        match self {
            Samples::U8(_) => ElementType::U8,
            Samples::I8(_) => ElementType::I8,
            Samples::U16(_) => ElementType::U16,
            Samples::I16(_) => ElementType::I16,
            Samples::U32(_) => ElementType::U32,
            Samples::I32(_) => ElementType::I32,
            Samples::U64(_) => ElementType::U64,
            Samples::I64(_) => ElementType::I64,
            Samples::F32(_) => ElementType::F32,
            Samples::F64(_) => ElementType::F64,
        }
    }
}
