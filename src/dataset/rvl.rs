//! RVL, the lossless compression of depth images by `compressedDepth`.
//!
//! A. D. Wilson, "Fast lossless depth image compression", ISS 2017. Numbers are written in nibbles
//! of three bits, least significant first, the fourth bit telling that another one follows; eight
//! nibbles fill a 32-bit word from its top, words are little-endian. Runs of zeros and of others
//! alternate, others as differences to the one before, the sign in the lowest bit.

use super::pixels::Rejection;

/// Values of a depth image of `pixels` pixels; memory and time are bounded by their number.
///
/// # Errors
/// If the data end early, or hold runs or values that do not fit the image.
pub(super) fn decode(data: &[u8], pixels: usize) -> Result<Vec<u16>, Rejection> {
    let mut numbers = Numbers { words: data.as_chunks::<4>().0.iter(), word: 0, nibbles: 0 };
    let mut values: Vec<u16> = Vec::new();
    let mut previous = 0_i32;
    while values.len() < pixels {
        let zeros = run(numbers.next()?, pixels - values.len())?;
        values.resize(values.len() + zeros, 0);
        let others = run(numbers.next()?, pixels - values.len())?;
        if zeros == 0 && others == 0 {
            return Err(damaged("two empty runs".to_owned()));
        }
        for _ in 0..others {
            let zigzag = numbers.next()?;
            let difference = (zigzag >> 1).cast_signed() ^ -(zigzag & 1).cast_signed();
            previous = previous.wrapping_add(difference);
            let value = u16::try_from(previous);
            values.push(value.map_err(|_| damaged(format!("a depth of {previous}")))?);
        }
    }
    Ok(values)
}

fn run(length: u32, left: usize) -> Result<usize, Rejection> {
    let length = length as usize;
    if length > left {
        return Err(damaged(format!("a run of {length} where {left} pixels are left")));
    }
    Ok(length)
}

fn damaged(detail: String) -> Rejection {
    Rejection::new("damaged RVL data", detail)
}

struct Numbers<'a> {
    words: std::slice::Iter<'a, [u8; 4]>,
    word: u32,
    /// Left in `word`.
    nibbles: u32,
}

impl Numbers<'_> {
    fn next(&mut self) -> Result<u32, Rejection> {
        let mut value = 0_u32;
        for shift in (0..u32::BITS).step_by(3) {
            if self.nibbles == 0 {
                let word = self.words.next();
                self.word = u32::from_le_bytes(*word.ok_or_else(|| damaged("cut short".into()))?);
                self.nibbles = 8;
            }
            let nibble = self.word >> 28;
            self.word <<= 4;
            self.nibbles -= 1;
            value |= (nibble & 7) << shift;
            if nibble & 8 == 0 {
                return Ok(value);
            }
        }
        Err(damaged("a number of more than 32 bits".to_owned()))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Compressed by hand: 2 zeros, 3 others (10: +10 is 20 as zigzag, 12: +2 is 4, 9: -3 is 5), 1
    /// zero, none. In nibbles 2 | 3 | 20 = 4 + 2 * 8: c 2 | 4 | 5 | 1 | 0.
    const BY_HAND: [u8; 4] = 0x23c2_4510_u32.to_le_bytes();

    #[test]
    fn an_image_compressed_by_hand_is_read() {
        assert_eq!(decode(&BY_HAND, 6).unwrap(), [0, 0, 10, 12, 9, 0]);
    }

    /// By the reference program's rules as written down in Python.
    #[test]
    fn an_image_of_another_encoder_is_read() {
        let values = [
            0, 0, 3597, 1274, 4952, 2225, 2390, 2522, 0, 0, 0, 4977, 0, 0, 0, 3110, 0, 0, 2331,
            1076, 4225, 801, 4287, 0,
        ];
        let data = [
            29, 142, 171, 38, 174, 207, 145, 200, 169, 161, 157, 29, 237, 49, 148, 88, 170, 29, 19,
            201, 61, 168, 93, 114, 193, 186, 74, 159, 252, 28, 173, 255, 0, 0, 16, 209,
        ];
        assert_eq!(decode(&data, values.len()).unwrap(), values);
    }

    #[test]
    fn numbers_cross_words() {
        // 0 zeros, 1 other: +65535 is 131070 = 0o377776, lowest digit first with their flags
        // e f f f f 3; then the next row of nibbles in a second word: 0 zeros, 1 other of -1.
        let words = [0x01ef_fff3_u32, 0x0110_0000];
        let data: Vec<u8> = words.iter().flat_map(|word| word.to_le_bytes()).collect();
        assert_eq!(decode(&data, 2).unwrap(), [65535, 65534]);
    }

    #[test]
    fn damage_is_refused() {
        let reason = |data: &[u8], pixels| decode(data, pixels).unwrap_err().detail;
        assert_eq!(reason(&BY_HAND[..3], 6), "cut short");
        assert_eq!(reason(&BY_HAND, 4), "a run of 3 where 2 pixels are left");
        assert_eq!(reason(&[0; 4], 6), "two empty runs");
        assert_eq!(reason(&0x0110_0000_u32.to_le_bytes(), 1), "a depth of -1");
        assert_eq!(reason(&[0xff; 8], 6), "a number of more than 32 bits");
    }

    proptest::proptest! {
        #[test]
        fn no_bytes_panic(data: Vec<u8>, pixels in 0_usize..5000) {
            if let Ok(values) = decode(&data, pixels) {
                assert_eq!(values.len(), pixels);
            }
        }
    }
}
